"""The page of MLflow that `armscan ui` prints, by what the server answers."""

import json
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import pytest

from armscan.tracking.view import VIEW_TAG
from armscan.ui.runs_page import runs_page

VIEW = {"key": VIEW_TAG, "value": "{}"}


@pytest.fixture
def server():
    """Yield a function that starts a server which answers searches of experiments and runs; it returns the address."""
    started = []

    def start(experiments, runs, status=200):
        class Answer(BaseHTTPRequestHandler):
            def do_POST(self):
                found = {"experiments": experiments} if "/experiments/" in self.path else {"runs": runs}
                self.send_response(status)
                self.end_headers()
                self.wfile.write(json.dumps(found).encode())

            def log_message(self, *_):
                pass

        started.append(HTTPServer(("127.0.0.1", 0), Answer))
        Thread(target=started[-1].serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{started[-1].server_port}"

    yield start
    for each in started:
        each.shutdown()
        each.server_close()


def of(experiment_id, *tags):
    return {"experiment_id": experiment_id, "name": "any", "tags": list(tags)}


def run_of(experiment_id):
    return {"info": {"experiment_id": experiment_id}}


@pytest.mark.parametrize(("tags", "view"), [([VIEW], "&viewStateShareKey=armscan"), ([], "")])
def test_page_is_that_of_the_experiment_with_the_latest_run(server, tags, view):
    address = server([of("0"), of("7", *tags)], [run_of("7")])
    assert runs_page(address) == f"{address}/#/experiments/7/runs?workflowType=machine_learning{view}"


@pytest.mark.parametrize(
    ("experiments", "runs", "status"),
    [([of("0")], [], 200), ([], [], 200), ([of("0")], [run_of("1")], 200), ([1], [run_of("1")], 200), ([], [], 500)],
)
def test_all_experiments_are_shown_where_no_run_is_known(server, experiments, runs, status):
    address = server(experiments, runs, status)
    assert runs_page(address) == f"{address}/#/experiments"


def test_id_of_an_experiment_adds_nothing_to_the_address(server):
    address = server([of("1&a=<b>")], [run_of("1&a=<b>")])
    assert runs_page(address).endswith("/experiments/1%26a%3D%3Cb%3E/runs?workflowType=machine_learning")
