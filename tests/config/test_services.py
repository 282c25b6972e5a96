"""Addresses and passwords of services."""

import os

import pytest
from omegaconf import OmegaConf

from armscan.config import credentials
from armscan.config.credentials import check_address, check_overrides, mask_passwords, read_password
from armscan.config.defaults import default_storage, default_tracking
from armscan.config.services import address_of, local_addresses, services_file
from armscan.errors import InvalidValueError

VARIABLES = ("ARMSCAN_STORAGE", "MLFLOW_TRACKING_URI", "MLFLOW_TRACKING_USERNAME")
PASSWORDS = (credentials.STORAGE_PASSWORD, credentials.TRACKING_PASSWORD, credentials.SERVER_PASSWORD)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Work in an empty folder, which also holds the user's configuration, with no services in the environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for variable in (*VARIABLES, *PASSWORDS):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path


@pytest.fixture
def write_local(here):
    def write(text):
        services_file().parent.mkdir(parents=True)
        services_file().write_text(text)

    return write


@pytest.mark.parametrize(
    ("uri", "has_password"),
    [
        ("postgresql://me:se%40cret@host:1/db", True),
        ("postgresql+psycopg://me:a:b@c@host:5432/db", True),
        ("postgresql://me:se/c@ret@host/db", True),
        ("postgresql://host/db?password=a&user=me", True),
        ("postgresql://me@host/db?sslmode=require&sslpassword=secret", True),
        ("https://me:secret@host/path", True),
        ("postgresql://me@host/db", False),
        ("postgresql://host:5432/db?sslmode=require", False),
        ("http://host:5000", False),
        ("http://me@host:5000/a@b", False),
        ("sqlite:///a.db", False),
        ("sqlite:////home/a:b@c/x.db", False),
        ("optuna.journal", False),
        ("/home/a:b@c/optuna.journal", False),
    ],
)
def test_address_with_a_password_is_refused_and_others_are_not(uri, has_password):
    if not has_password:
        check_address("storage", uri)
        return
    with pytest.raises(InvalidValueError, match=r"^storage has a password in its address") as raised:
        check_address("storage", uri)
    assert "secret" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "uri", "instead"),
    [
        ("study.storage", "postgresql://me:secret@host/db", r"~/.pgpass .* PGPASSFILE names, or set ARMSCAN_STORAGE_"),
        ("tracking.uri", "postgresql://me:secret@host/db", r"~/.pgpass .* PGPASSFILE names, or set ARMSCAN_TRACKING_"),
        ("tracking.uri", "http://me:secret@host", "set MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD$"),
    ],
)
def test_refused_address_says_where_to_put_the_password(name, uri, instead):
    with pytest.raises(InvalidValueError, match=instead):
        check_address(name, uri)


def test_words_with_a_password_are_refused_and_others_are_not():
    check_overrides(["a=b", "storage=postgresql://me@host/db", "x=http://host/a?b=c", "a:b@c"])
    with pytest.raises(InvalidValueError, match=r"^storage has a password in its address"):
        check_overrides(["storage='postgresql://me:secret@host/db'"])
    for value in (
        "sqlite:///mlruns.db,postgresql://me:secret@host/db",
        "{uri: 'http://me:secret@host'}",
        r"postgresql\://me\:secret@host/db",
    ):
        with pytest.raises(InvalidValueError, match=r"^tracking.uri has a password in its address"):
            check_overrides([f"tracking.uri={value}"])
    check_overrides(["tracking.uri=http://host:5000,http://me@host:5001/a@b"])
    check_overrides(["tracking.uri=postgresql://h:5432/a,postgresql://me@h:5432/b"])


def test_service_is_where_the_environment_says(monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://me@host/db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://host:5000")
    assert default_storage() == "postgresql://me@host/db"
    assert default_tracking()["uri"] == "http://host:5000"


@pytest.mark.parametrize(
    ("variable", "service"), [("ARMSCAN_STORAGE", "storage"), ("MLFLOW_TRACKING_URI", "tracking_uri")]
)
def test_variable_with_a_password_is_refused(monkeypatch, variable, service):
    monkeypatch.setenv(variable, "postgresql://me:secret@host/db")
    with pytest.raises(InvalidValueError, match=f"^{variable} has a password in its address"):
        address_of(service)


def test_service_is_where_the_local_file_says_only_where_it_is_asked_for(write_local):
    write_local("{storage: 'postgresql://me@host/db', tracking_uri: 'postgresql://me@host/runs'}")
    assert default_storage() == "optuna.journal"
    assert address_of("storage") == "postgresql://me@host/db"
    assert address_of("tracking_uri") == "postgresql://me@host/runs"


def test_empty_local_file_says_nothing(write_local):
    write_local("# storage: postgresql://me@host/db\n")
    assert local_addresses() == {}


def test_local_file_is_in_the_configuration_folder_of_the_user(here):
    assert services_file() == here / "config" / "armscan" / "services.yaml"


def test_service_that_nobody_has_named_is_told_with_where_to_name_it():
    with pytest.raises(InvalidValueError, match=r"neither ARMSCAN_STORAGE is set nor is there a storage in .*services"):
        address_of("storage")


@pytest.mark.parametrize(
    ("contents", "answer"),
    [
        ("storage: [secret", "cannot be read: ParserError"),
        ("secret", "must contain only storage or tracking_uri, each with an address"),
        ("storage: {a: secret}", "must contain only storage or tracking_uri, each with an address"),
        ("password: secret", "has 'password', but it must contain only storage or tracking_uri"),
        ("storage: postgresql://me:secret@host/db", "storage in .*services.yaml has a password in its address"),
    ],
)
def test_local_file_that_says_something_else_is_answered_without_what_it_holds(write_local, contents, answer):
    write_local(contents)
    with pytest.raises(InvalidValueError, match=answer) as raised:
        address_of("storage")
    assert "secret" not in str(raised.value)


def test_password_comes_from_a_file_where_the_environment_names_one(tmp_path, monkeypatch):
    (tmp_path / "secret").write_text("a b\n")
    monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD_FILE", str(tmp_path / "secret"))
    assert read_password("ARMSCAN_STORAGE_PASSWORD") == "a b"
    (tmp_path / "empty").write_text("\n")
    (tmp_path / "binary").write_bytes(b"\xff")
    for name, reason in (("empty", "is empty"), ("binary", "it is not text")):
        monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD_FILE", str(tmp_path / name))
        with pytest.raises(InvalidValueError, match=f"ARMSCAN_STORAGE_PASSWORD_FILE is .*{name}.*{reason}"):
            read_password("ARMSCAN_STORAGE_PASSWORD")
    monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD_FILE", str(tmp_path / "nothing"))
    with pytest.raises(InvalidValueError, match=r"ARMSCAN_STORAGE_PASSWORD_FILE is .*nothing', but it cannot be read"):
        read_password("ARMSCAN_STORAGE_PASSWORD")


@pytest.mark.parametrize("variable", [*PASSWORDS, "MLFLOW_TRACKING_TOKEN", "PGPASSWORD"])
@pytest.mark.parametrize("is_in_file", [False, True])
def test_masked_text_has_no_password(tmp_path, monkeypatch, variable, is_in_file):
    (tmp_path / "file").write_text("secret\n")
    name, value = (f"{variable}_FILE", str(tmp_path / "file")) if is_in_file else (variable, "secret")
    monkeypatch.setenv(name, value)
    monkeypatch.setenv("ARMSCAN_TRACKING_PASSWORD_FILE" if variable != PASSWORDS[1] else "PGPASSWORD_FILE", "nowhere")
    assert mask_passwords("http://a:b@c: secret and postgresql://d@e") == "http://a:***@c: *** and postgresql://d@e"


def test_configuration_resolves_to_addresses(monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://me@host/db")
    config = OmegaConf.create({"storage": "${armscan.service:storage}"})
    assert OmegaConf.to_yaml(config, resolve=True) == "storage: postgresql://me@host/db\n"
    assert not [name for name in PASSWORDS if name in os.environ]
