"""Requests that other web pages send to the dashboard."""

import http.client
import json
from urllib.parse import urlsplit

import optuna
import pytest

from armscan.sweeps.storage.storage import open_storage
from armscan.ui.servers import HOST, start_dashboard
from tests.support.ports import free_port

FOREIGN = [
    {"Host": "attacker.example:{port}"},
    {"Host": "attacker.example"},
    {"Host": ""},
    {"Host": "127.0.0.1.attacker.example:{port}"},
    {"Host": "127.0.0.1:1"},
    {"Origin": "http://attacker.example"},
    {"Origin": "http://attacker.example:{port}"},
    {"Origin": "http://127.0.0.1:1"},
    {"Origin": "null"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]


@pytest.fixture(scope="module")
def dashboard(tmp_path_factory):
    """Start a dashboard with one study; return its address and the storage."""
    folder = tmp_path_factory.mktemp("dashboard")
    storage = open_storage(str(folder / "optuna.journal"))
    optuna.create_study(study_name="mine", storage=storage.optuna)
    (folder / "artifacts").mkdir()
    return start_dashboard(storage, folder / "artifacts", free_port()), storage.optuna


def status_of(address, method, path, headers, body=None):
    """Send a request with exactly these headers; return the status of the answer."""
    place = urlsplit(address)
    connection = http.client.HTTPConnection(HOST, place.port)
    connection.putrequest(method, path, skip_host=True)
    headers = {"Host": place.netloc, "Content-Length": str(len(body or b""))} | headers
    for name, value in headers.items():
        connection.putheader(name, value.format(port=place.port))
    connection.endheaders(body)
    status = connection.getresponse().status
    connection.close()
    return status


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
def test_no_page_of_others_deletes_or_makes_studies(dashboard, headers):
    address, storage = dashboard
    (study,) = storage.get_all_studies()
    new = json.dumps({"study_name": "theirs", "directions": ["minimize"]}).encode()
    requests = [("DELETE", f"/api/studies/{study._study_id}", None), ("POST", "/api/studies", new)]
    requests += [("POST", f"/api/studies/{study._study_id}/rename", b"study_name=theirs")]
    for method, path, body in requests:
        # The content type of a form, which needs no CORS preflight.
        assert status_of(address, method, path, {"Content-Type": "text/plain"} | headers, body) == 403, path
    assert [each.study_name for each in storage.get_all_studies()] == ["mine"]


@pytest.mark.parametrize("headers", FOREIGN[:-2], ids=str)
def test_no_page_of_others_reads_studies(dashboard, headers):
    assert status_of(dashboard[0], "GET", "/api/studies", headers) == 403


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_own_pages_read_and_write(dashboard, host):
    address, storage = dashboard
    (study,) = storage.get_all_studies()
    own = {"Host": f"{host}:{{port}}", "Origin": f"http://{host}:{{port}}", "Sec-Fetch-Site": "same-origin"}
    assert status_of(address, "GET", "/api/studies", {"Host": own["Host"]}) == 200
    note = json.dumps({"body": "seen", "version": 1}).encode()
    path = f"/api/studies/{study._study_id}/note"
    assert status_of(address, "PUT", path, own | {"Content-Type": "application/json"}, note) in (204, 409)
