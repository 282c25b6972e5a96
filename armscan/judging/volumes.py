"""The volumes that an agent is judged on, by what they are to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig

from armscan.errors import InvalidValueError
from armscan.mistakes import mistake_in_one_line
from armscan.training import TEST, TRAINING, VALIDATION, Split
from armscan.volumes import LabelVolume, load_phantoms, open_dataset
from armscan.volumes.dataset import SPLITS

PHANTOMS = "phantoms"
# No phantom of a run has these seeds: its test phantoms begin a million below.
PHANTOMS_FIRST_SEED = 3_000_000
Volumes = dict[str, LabelVolume]


def own_split(config: DictConfig) -> Split:
    """Reads the volumes that a configuration describes."""
    split: Split = instantiate(config.data, _convert_="object")
    return split


def volume_groups(data: str | None, n_phantoms: int, own: Callable[[], Split]) -> dict[str, Volumes]:
    """Returns the volumes to judge on, by what they are called.

    Args:
        data: a folder, `phantoms` for phantoms that no run trains on, None for the agent's own volumes.
        n_phantoms: how many phantoms.
        own: reads the agent's own volumes.
    """
    if data is None:
        split = own()
        return {TRAINING: split.training, VALIDATION: split.validation, TEST: split.test}
    if data == PHANTOMS:
        return {"new phantoms": load_phantoms(range(PHANTOMS_FIRST_SEED, PHANTOMS_FIRST_SEED + n_phantoms), None)}
    dataset = open_dataset(data)
    groups = {f"{split} split": dataset.volumes_of(split) for split in SPLITS}
    return {label: volumes for label, volumes in groups.items() if volumes} or {"volumes": dataset.volumes}


def data_name(data: str | None) -> str:
    """Returns what volumes are called in the names of files and runs."""
    return "own volumes" if data is None else Path(data).resolve().name


def known_volumes(tags: Mapping[str, str], groups: Mapping[str, Volumes]) -> list[str]:
    """Returns a sentence for each purpose that a run has had volumes of these names for.

    Args:
        tags: of the run.
        groups: the volumes, by what they are called.
    """
    names = [name for volumes in groups.values() for name in volumes]
    notes = []
    for part, what in (
        ("training", "the agent was trained on"),
        ("validation", "the agent's checkpoint was chosen on"),
    ):
        had = tags.get(f"volumes.{part}", "").split(" ")
        if known := [name for name in names if name in had]:
            notes.append(f"{what} volumes of these names: {', '.join(known)}")
    return notes


class TrainingVolumes(Mapping[str, LabelVolume]):
    """The training volumes, which are not read before somebody looks at them: only some rewards do.

    Args:
        load: reads the volumes of a run.
    """

    def __init__(self, load: Callable[[], Split]) -> None:
        self._load = load

    @cached_property
    def _volumes(self) -> Volumes:
        try:
            return self._load().training
        # Hydra wraps whatever is raised while it builds.
        except Exception as error:
            line = mistake_in_one_line(error)
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
