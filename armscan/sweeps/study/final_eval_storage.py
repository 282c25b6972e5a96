"""Where a final evaluation is stored: the studies of its selection and test, and its settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import optuna
from optuna.study import StudyDirection
from pydantic import Field

from armscan.errors import StudyError
from armscan.sweeps.space.parameter import Value
from armscan.sweeps.storage.attributes import FINAL_SUFFIXES, SELECTION_SUFFIX, TEST_SUFFIX, check_trials
from armscan.sweeps.storage.storage import Storage
from armscan.sweeps.study.final_eval import FinalEvaluation, config_sha256_of
from armscan.sweeps.study.settings import MAX_SEARCH_SEED, FinalEvalSettings, StudySettings
from armscan.utils.section import Section

# User attribute of the study of the selection: its settings, for reports.
FINAL_EVAL = "final_eval"


class _Stored(Section):
    """Settings of a final evaluation, as the study of the selection stores them; see `FinalEvaluation`."""

    settings: FinalEvalSettings = Field(description="a section with the keys of study.final_eval")
    search_seed: int = Field(ge=0, le=MAX_SEARCH_SEED, description="the largest seed of the search")
    control: dict[str, Value] | None = Field(default=None, description="the values of the control by their keys")


def open_final_eval(
    storage: Storage, settings: StudySettings, search: optuna.Study, control: Mapping[str, Value] | None
) -> FinalEvaluation:
    """Create the two studies of a final evaluation, or load them.

    Args:
        storage: Storage of the study.
        settings: Settings of the whole study.
        search: Study of the search.
        control: Values of the control by the searched keys; None if they do not lie in the space.
    """

    def make(suffix: str, directions: Sequence[StudyDirection]) -> optuna.Study:
        study = storage.exclusive(
            lambda: optuna.create_study(
                study_name=settings.name + suffix,
                storage=storage.optuna,
                directions=directions,
                load_if_exists=True,
            )
        )
        check_trials(study, n_searched=len(search.get_trials(deepcopy=False)))
        return study

    selection = make(SELECTION_SUFFIX, search.directions)
    stored = {
        "settings": settings.final_eval.model_dump(),
        "search_seed": max(settings.seeds),
        "control": None if control is None else dict(control),
    }
    if selection.user_attrs.get(FINAL_EVAL) != stored:
        selection.set_user_attr(FINAL_EVAL, stored)
    test = make(TEST_SUFFIX, [StudyDirection.MINIMIZE])
    return FinalEvaluation(
        settings.final_eval, max(settings.seeds), control, search, selection, test, config_sha256_of(search)
    )


def stored_final_eval(storage: Storage, search: optuna.Study) -> FinalEvaluation | None:
    """Return the final evaluation of a stored study; None if none was begun, or an earlier version made it."""
    selection, test = (storage.study(search.study_name + suffix) for suffix in FINAL_SUFFIXES)
    if selection is None or test is None:
        return None
    for study in (selection, test):
        check_trials(study, n_searched=len(search.get_trials(deepcopy=False)))
    where, found = f"{selection.study_name}.user_attrs.{FINAL_EVAL}", selection.user_attrs.get(FINAL_EVAL)
    if not isinstance(found, Mapping):
        raise StudyError(f"{where} is {found!r}, but it must be the settings of the final evaluation")
    settings = found.get("settings")
    if isinstance(settings, Mapping) and "max_seeds" in settings:
        # Its race had other rules.
        return None
    kept = _Stored.read(where, found)
    return FinalEvaluation(
        kept.settings, kept.search_seed, kept.control, search, selection, test, config_sha256_of(search)
    )
