"""The compose files, checked by the Compose Specification's own schema, and by what is expected of ours."""

import json
import re

import jsonschema
import pytest
import yaml

from tests.conftest import DATA
from tests.docker.files import COMPOSE, CUDA, FOLDER, read_compose, read_image, variables_of
from tests.support import REPOSITORY

SERVICES = ("postgres", "mlflow", "dashboard", "worker")


@pytest.fixture(scope="module")
def compose():
    return read_compose()


@pytest.mark.parametrize("path", [COMPOSE, CUDA], ids=lambda path: path.name)
def test_file_is_by_the_specification(path):
    schema = json.loads((DATA / "compose" / "compose-spec.json").read_text())
    validator = jsonschema.validators.validator_for(schema)(schema)
    # As it stands, and as it is once its variables have their values.
    for composed in (yaml.safe_load(path.read_text()), read_compose(path)):
        assert [f"{error.json_path}: {error.message}" for error in validator.iter_errors(composed)] == []


def test_schema_refuses_what_is_no_compose_file():
    schema = json.loads((DATA / "compose" / "compose-spec.json").read_text())
    wrong = {"services": {"worker": {"image": "a", "depends_on": {"b": {"condition": "healthy"}}}}}
    assert not jsonschema.validators.validator_for(schema)(schema).is_valid(wrong)


def test_services_are_those_and_each_is_restarted_and_looked_after(compose):
    assert tuple(compose["services"]) == SERVICES
    for name, service in compose["services"].items():
        assert service["restart"] == ("on-failure:5" if name == "worker" else "unless-stopped")
        # A worker's is in the image.
        assert ("healthcheck" in service) == (name != "worker")
    assert read_image().healthcheck


def test_ports_are_bound_to_the_loopback_address(compose):
    ports = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:5432:5432", "127.0.0.1:5000:5000", "127.0.0.1:8080:8080"]
    elsewhere = read_compose(ARMSCAN_ADDRESS="192.0.2.1", MLFLOW_PORT="5001")["services"]
    assert elsewhere["mlflow"]["ports"] == ["192.0.2.1:5001:5000"]


def test_each_is_started_when_those_that_it_needs_answer(compose):
    needed = {name: set(service.get("depends_on", {})) for name, service in compose["services"].items()}
    assert needed == {
        "postgres": set(),
        "mlflow": {"postgres"},
        "dashboard": {"postgres"},
        "worker": {"postgres", "mlflow"},
    }
    conditions = [each for service in compose["services"].values() for each in service.get("depends_on", {}).values()]
    assert all(each == {"condition": "service_healthy"} for each in conditions)


def test_workers_can_be_many(compose):
    worker = compose["services"]["worker"]
    # Only one worker could have a given name, host name or port.
    assert {"container_name", "hostname", "network_mode", "ports"} & worker.keys() == set()
    assert "study.workers=1" in worker["command"].split()
    assert int(worker["stop_grace_period"].removesuffix("s")) >= 15


def test_volumes_have_names_and_so_survive(compose):
    mounted = [volume for service in compose["services"].values() for volume in service.get("volumes", [])]
    sources = {volume.partition(":")[0] for volume in mounted}
    assert {source for source in sources if not source.startswith("./")} == set(compose["volumes"])
    assert {source for source in sources if source.startswith("./")} == {"./databases.sql"}
    # The image's user owns the folders that it writes to in the image, and so in a fresh volume.
    targets = {volume.split(":")[1] for volume in mounted if volume.count(":") == 1}
    theirs = {"/var/lib/postgresql/data"}
    assert targets - theirs == set(re.findall(r"(?<= )/\w+", read_image().words["RUN"]))


def test_password_is_in_a_file_and_never_in_the_text(compose):
    assert compose["secrets"] == {"database_password": {"file": "./secrets/database_password"}}
    for service in compose["services"].values():
        assert service["secrets"] == ["database_password"]
        given = {key: value for key, value in service["environment"].items() if "PASSWORD" in key}
        assert list(given.values()) == ["/run/secrets/database_password"]
        assert all(key.endswith("_FILE") for key in given)
    # An address with a password.
    assert re.findall(r"//[^/\s@]+:[^/\s@]+@", COMPOSE.read_text()) == []
    assert "docker/secrets/" in (REPOSITORY / ".gitignore").read_text().splitlines()


def test_containers_of_our_image_can_do_little(compose):
    ours = [service for service in compose["services"].values() if "build" in service]
    assert len(ours) == 3
    for service in ours:
        assert service["init"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["build"]["context"] == ".."
        assert (FOLDER / service["build"]["context"] / service["build"]["dockerfile"]).exists()


def test_image_for_cuda_and_an_empty_build_are_asked_for_by_variables():
    assert read_compose(TORCH_BUILD="cu130")["services"]["worker"]["build"]["args"]["TORCH_BUILD"] == "cu130"
    assert read_compose(TORCH_BUILD="")["services"]["worker"]["build"]["args"]["TORCH_BUILD"] == ""
    assert read_compose()["services"]["worker"]["build"]["args"]["TORCH_BUILD"] == "cpu"


def test_example_of_settings_names_every_variable_with_its_default():
    lines = (FOLDER / ".env.example").read_text().splitlines()
    named = dict(line[1:].split("=", 1) for line in lines if re.match(r"#\w+=", line))
    assert named == variables_of(COMPOSE)
