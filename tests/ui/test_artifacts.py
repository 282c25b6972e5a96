"""Artifacts of a study made by somebody else: which files they name, and how they are served."""

import base64
import http.client
import json
from urllib.parse import urlsplit

import optuna
import pytest
import requests

from armscan.sweeps.storage.storage import open_storage
from armscan.ui.servers import HOST, start_dashboard
from tests.support.ports import free_port

SECRET, CONTENTS = "secret", "nobody may see it"
PATHS = ["../{}", "..%2f{}", "%2e%2e/{}", "a/../../{}", "/{}", "..\\{}", "{}%00", "....//{}"]


@pytest.fixture(scope="module")
def dashboard(tmp_path_factory):
    """Start a dashboard with a file beside its artifacts; return its address, a study and the folder."""
    folder = tmp_path_factory.mktemp("dashboard")
    storage = open_storage(str(folder / "optuna.journal"))
    study = optuna.create_study(study_name="theirs", storage=storage.optuna)
    study.ask()
    (folder / "artifacts").mkdir()
    (folder / SECRET).write_text(CONTENTS)
    return start_dashboard(storage, folder / "artifacts", free_port()), study, folder


def answer_to(address, method, path):
    """Request a path exactly as written (other clients would remove the dots); return status and body."""
    connection = http.client.HTTPConnection(HOST, urlsplit(address).port)
    connection.request(method, path, headers={"Content-Type": "application/json"})
    answer = connection.getresponse()
    body = answer.read().decode(errors="replace")
    connection.close()
    return answer.status, body


def artifact_of(study, artifact_id, mimetype="text/html"):
    meta = {"artifact_id": artifact_id, "filename": f"../{SECRET}", "mimetype": mimetype, "encoding": None}
    for key in (f"artifacts:{artifact_id}", f"dashboard:artifacts:0:{artifact_id}"):
        study._storage.set_study_system_attr(study._study_id, key, json.dumps(meta))
        study._storage.set_trial_system_attr(study.trials[0]._trial_id, key, json.dumps(meta))


@pytest.mark.parametrize("path", PATHS)
def test_artifact_that_names_another_file_is_neither_shown_nor_removed(dashboard, path):
    address, study, folder = dashboard
    for name in (path.format(SECRET), path.format(str(folder / SECRET))):
        artifact_of(study, name)
        for method in ("GET", "DELETE"):
            for place in ("/artifacts/{}/", "/artifacts/{}/0/", "/api/artifacts/{}/", "/api/artifacts/{}/0/"):
                status, body = answer_to(address, method, place.format(study._study_id) + name)
                assert status >= 400
                assert CONTENTS not in body
    assert (folder / SECRET).read_text() == CONTENTS


@pytest.mark.parametrize("filename", [f"../{SECRET}", "/etc/passwd", "a\r\nb", "a\0b"])
def test_uploaded_artifact_stays_in_its_folder(dashboard, filename):
    address, study, folder = dashboard
    before = {file for file in folder.rglob("*") if file.parent.name != "artifacts"}
    sent = {"file": f"data:text/plain;base64,{base64.b64encode(b'x').decode()}", "filename": filename}
    for place in (f"/api/artifacts/{study._study_id}", f"/api/artifacts/{study._study_id}/0"):
        assert requests.post(address + place, json=sent, timeout=60).status_code == 201
    assert {file for file in folder.rglob("*") if file.parent.name != "artifacts"} == before
    assert (folder / SECRET).read_text() == CONTENTS


def test_page_among_the_artifacts_runs_no_script(dashboard):
    address, study, folder = dashboard
    artifact_of(study, "abc")
    (folder / "artifacts" / "abc").write_text("<script>fetch('/api/studies')</script>")
    answer = requests.get(f"{address}/artifacts/{study._study_id}/abc", timeout=60)
    assert answer.headers["Content-Type"].startswith("text/html")
    assert answer.headers["Content-Security-Policy"] == "sandbox"
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    for place in ("%ffartifacts", "artifacts%ff"):
        assert requests.get(f"{address}/{place}/{study._study_id}/abc", timeout=60).status_code == 403
    assert "Content-Security-Policy" not in requests.get(f"{address}/api/studies", timeout=60).headers


def test_metadata_of_an_artifact_adds_no_header(dashboard):
    address, study, folder = dashboard
    artifact_of(study, "def", mimetype="text/plain\r\nSet-Cookie: a=b")
    (folder / "artifacts" / "def").write_text("x")
    answer = requests.get(f"{address}/artifacts/{study._study_id}/def", timeout=60)
    assert "Set-Cookie" not in answer.headers
