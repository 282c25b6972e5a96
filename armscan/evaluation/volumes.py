"""Volumes of an evaluation: the run's own, a folder, or phantoms."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from hydra.utils import instantiate

from armscan.config.defaults import PHANTOM
from armscan.config.error_messages import one_line_message
from armscan.errors import InvalidValueError, few
from armscan.evaluation.agent_source import EvaluatedAgent
from armscan.tracking.tags import HOST_TAG, SUBJECTS, VOLUMES, WORKING_FOLDER_TAG
from armscan.training import PARTS, TEST, TRAINING, VALIDATION, Split, check_unchanged
from armscan.utils.files import check_writable, sha256
from armscan.volumes import LabelVolume, load_phantoms, open_dataset
from armscan.volumes.dataset import SPLITS, planes_found_by
from armscan.volumes.phantom import VERSIONS

# Above the seeds of a run's phantoms: its test phantoms begin a million below.
PHANTOMS_FIRST_SEED = 3_000_000
# Names of files have at most 255 bytes.
MAX_PART_BYTES = 50
VolumesByName = dict[str, LabelVolume]


def own_split(source: EvaluatedAgent, parts: Sequence[str] = PARTS) -> Split:
    """Read an agent's own volumes: those that its configuration describes.

    Args:
        source: Agent whose volumes are read.
        parts: Parts of the split whose volumes must not have changed since the run was started.

    Raises:
        ChangedVolumesError: If they have.
        InvalidValueError: If they cannot be read.
    """
    run = source.run
    try:
        split: Split = instantiate(source.config.data, _convert_="object")
    # Hydra wraps exceptions raised by constructors.
    except Exception as error:
        line = one_line_message(error)
        if run is None or line is None:
            raise
        where = run.tags.get(WORKING_FOLDER_TAG, "a folder that was not kept")
        host = run.tags.get(HOST_TAG, "some host")
        raise InvalidValueError(
            f"the volumes of run {run.run_id} cannot be read: {line} (it was started in {where} on {host})"
        ) from error
    if run is not None and source.volumes is not None:
        now = {part: prints for part, prints in split.fingerprints().items() if part in parts}
        check_unchanged(source.volumes, now, f"run {run.run_id} was started with")
    return split


def phantom_version(source: EvaluatedAgent) -> int:
    """Return the version of the phantoms in an agent's own configuration; 1 if it names none of them."""
    named = source.config.data.get("version")
    return next((version for version in VERSIONS if version == named), 1)


def volume_groups(
    data: str | None, n_phantoms: int, own: Callable[[], Split], version: int
) -> dict[str, VolumesByName]:
    """Return the volumes to evaluate on, by group name.

    Args:
        data: Folder, `phantom` for phantoms that no run trains on, or None for the agent's own volumes.
        n_phantoms: Number of phantoms.
        own: Function that reads the agent's own volumes.
        version: Version of the phantoms.
    """
    if data is None:
        split = own()
        return {TRAINING: split.training, VALIDATION: split.validation, TEST: split.test}
    if data == PHANTOM:
        label = "new phantoms" if version == 1 else f"new phantoms of version {version}"
        return {label: load_phantoms(range(PHANTOMS_FIRST_SEED, PHANTOMS_FIRST_SEED + n_phantoms), None, version)}
    dataset = open_dataset(data)
    groups = {f"{split} split": dataset.volumes_of(split) for split in SPLITS}
    return {label: volumes for label, volumes in groups.items() if volumes} or {"volumes": dataset.volumes}


def notes_on_planes(folder: str, run_id: str | None) -> list[str]:
    """Return a note if agents have found labelled planes of a folder, and another if the agent of this run has.

    Args:
        folder: Folder of the volumes.
        run_id: MLflow run ID of the agent; None for an agent without a run.
    """
    found_by = planes_found_by(folder)
    own = [name for name, agent in found_by.items() if agent == run_id]
    notes = []
    if others := [name for name in found_by if name not in own]:
        notes.append(f"agents have found the labelled planes of {few(others)}: distances are from planes of agents")
    if own:
        notes.append(
            f"this agent has found the labelled planes of {few(own)} itself: on these volumes, the figures say whether "
            "it finds the same plane again, not how far it is from the right one"
        )
    return notes


def data_name(data: str | None) -> str:
    """Return the name of the volumes for files and runs."""
    return "configured volumes" if data is None else Path(data).resolve().name


def file_name(*parts: str) -> str:
    """Return strings as a valid file name, each shortened so that up to four of them, and an ending, fit."""
    return "-".join(map(_shortened, parts))


def _shortened(part: str) -> str:
    valid = re.sub(r"[^\w.\-]+", "-", part).encode()
    if len(valid) > MAX_PART_BYTES:
        # Names that begin alike stay apart.
        valid = valid[: MAX_PART_BYTES - 9] + f"-{sha256(valid)[:8]}".encode()
    return valid.decode(errors="ignore")


def check_out(file: Path, out: Path | None, what: str) -> None:
    """Check that a file can be written, before the agent plays for hours.

    Raises:
        InvalidValueError: If it cannot be written; the message names `--out` and `what`.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        check_writable(file)
    except OSError as error:
        named = str(out or file)
        raise InvalidValueError(f"--out is {named!r}, but no {what} can be written there: {error.strerror}") from error


def known_volumes(source: EvaluatedAgent, groups: Mapping[str, VolumesByName]) -> list[str]:
    """Return a sentence for each way in which an agent's run used these volumes, or others of their names or subjects.

    Args:
        source: Agent of a run.
        groups: Volumes by the name of their group.
    """
    assert source.run is not None
    volumes = {name: volume for group in groups.values() for name, volume in group.items()}
    prints = {name: volume.fingerprint for name, volume in volumes.items()} if source.volumes else {}
    notes = []
    for part, what in (
        ("training", "the agent was trained on"),
        ("validation", "the agent's checkpoint was chosen on"),
    ):
        had = (source.volumes or {}).get(part, {})
        names_of = {print_: name for name, print_ in had.items()}
        same = {name: names_of[print_] for name, print_ in prints.items() if print_ in names_of}
        if same:
            shown = (name if name == there else f"{name} (there {there})" for name, there in same.items())
            notes.append(f"{what} these volumes: {', '.join(shown)}")
        names = had or source.run.tags.get(f"{VOLUMES}{part}", "").split(" ")
        subjects = source.run.tags.get(f"{SUBJECTS}{part}", "").splitlines()
        if others := [name for name in volumes if name in names and name not in same]:
            which = ", but with other voxels or another plane" if had else ""
            notes.append(f"{what} volumes of these names{which}: {', '.join(others)}")
        if others := [name for name in volumes if volumes[name].subject in subjects and name not in (*same, *names)]:
            notes.append(f"{what} other volumes of the same subjects as: {', '.join(others)}")
    return notes


def are_known(source: EvaluatedAgent, volumes: VolumesByName) -> bool:
    """Return whether an agent's run has learned from one of these volumes, or chosen its checkpoint on it."""
    used = source.volumes or {}
    prints = {each for part in ("training", "validation") for each in used.get(part, {}).values()}
    return any(volume.fingerprint in prints for volume in volumes.values())


class TrainingVolumes(Mapping[str, LabelVolume]):
    """Training volumes that `load` reads on first use; few rewards use them."""

    def __init__(self, load: Callable[[], Split]) -> None:
        self._load = load

    @cached_property
    def _volumes(self) -> VolumesByName:
        try:
            return self._load().training
        # Hydra wraps exceptions raised by constructors.
        except Exception as error:
            line = one_line_message(error)
            if line is None:
                raise
            raise InvalidValueError(
                f"the reward is fitted to the volumes that the agent was trained on, but they cannot be read: {line}"
            ) from error

    def __getitem__(self, name: str) -> LabelVolume:
        return self._volumes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._volumes)

    def __len__(self) -> int:
        return len(self._volumes)
