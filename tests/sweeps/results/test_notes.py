import pytest

from armscan.sweeps.results.notes import code_notes, notes_on
from armscan.sweeps.storage.attribute_names import CODE, LEASE
from armscan.sweeps.storage.storage import open_storage
from armscan.sweeps.study.study import make_study
from armscan.tracking import code_version
from tests.sweeps.study.test_study import settings


@pytest.mark.parametrize(
    ("codes", "counts"),
    [
        (["c1 aa", "c1 aa"], ""),
        # A commit that changes no code, and trials of earlier versions.
        (["c1 aa", "c2 aa", None], ""),
        (["c1 aa", "c2 bb", "c1 aa"], "c1 aa: 2, c2 bb: 1"),
        # Changes without a commit.
        (["c1 aa", "c1 bb"], "c1 aa: 1, c1 bb: 1"),
    ],
)
def test_trials_of_different_code_are_noted(tmp_path, codes, counts):
    study = make_study(open_storage(str(tmp_path / "a.journal")), settings(), {})
    for code in codes:
        trial = study.ask()
        trial.set_user_attr(LEASE, {"worker": "w"} | ({CODE: code} if code else {}))
        study.tell(trial, 1.0)
    study.ask().set_user_attr(LEASE, {CODE: "c9 zz"})
    versions = f"different versions of armscan's code (commit, checksum: trials; {counts})"
    noted = f"its trials had {versions}; their values may differ"
    assert notes_on(study) == ([noted] if counts else [])
    assert code_notes(study, "the trainings") == ([noted.replace("its trials", "the trainings")] if counts else [])


def test_version_of_the_code_has_the_commit_and_a_checksum_of_the_source():
    version, checksum = code_version().split()
    assert len(version) in (5, 9)
    assert len(checksum) == 12
