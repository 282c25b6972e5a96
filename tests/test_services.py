"""Where services are, and how their passwords come in."""

import os

import pytest
from omegaconf import OmegaConf

from armscan import passwords
from armscan.errors import InvalidValueError
from armscan.passwords import check_words, masked, password_in, password_of, without_password
from armscan.services import LOCAL_FILE, address_of, hand_over_local, local_addresses
from armscan.settings import usual_storage, usual_tracking

VARIABLES = ("ARMSCAN_STORAGE", "MLFLOW_TRACKING_URI", "MLFLOW_TRACKING_USERNAME")
PASSWORDS = (passwords.STORAGE_PASSWORD, passwords.TRACKING_PASSWORD, passwords.SERVER_PASSWORD)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """An empty folder, and an environment that says nothing; what is set is not kept."""
    monkeypatch.chdir(tmp_path)
    for variable in (*VARIABLES, *PASSWORDS):
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    return tmp_path


@pytest.fixture
def write_local(here):
    def write(text):
        LOCAL_FILE.parent.mkdir(parents=True)
        LOCAL_FILE.write_text(text)

    return write


@pytest.mark.parametrize(
    ("uri", "password", "shown"),
    [
        ("postgresql://me:se%40cret@host:1/db", "se@cret", "postgresql://me@host:1/db"),
        ("postgresql://host/db?password=a&user=me", "a", "postgresql://host/db?user=me"),
        ("postgresql://me@host/db", None, "postgresql://me@host/db"),
        ("http://host:5000", None, "http://host:5000"),
        ("https://me:secret@host/path", "secret", "https://me@host/path"),
        ("sqlite:///a.db", None, "sqlite:///a.db"),
        ("optuna.journal", None, "optuna.journal"),
        ("sqlite:////home/a:b@c/x.db", None, "sqlite:////home/a:b@c/x.db"),
        ("http://host:5000/a@b", None, "http://host:5000/a@b"),
        ("postgresql://me:se/c@ret@host/db", "se/c@ret", "postgresql://me@host/db"),
        ("postgresql://me@host/db?sslpassword=secret", "secret", "postgresql://me@host/db"),
    ],
)
def test_password_is_told_from_its_address(uri, password, shown):
    assert (password_in(uri), without_password(uri)) == (password, shown)


def test_service_is_where_the_environment_says_and_its_password_is_handed_over(monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://me:secret@host/db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://you:hidden@host:5000")
    assert usual_storage() == "postgresql://me@host/db"
    assert usual_tracking()["uri"] == "http://host:5000"
    assert [os.environ.get(name) for name in PASSWORDS] == ["secret", None, "hidden"]
    assert os.environ["MLFLOW_TRACKING_USERNAME"] == "you"


def test_service_is_where_the_local_file_says_only_where_it_is_asked_for(write_local):
    write_local("{storage: 'postgresql://me:secret@host/db', tracking_uri: 'postgresql://me:hidden@host/runs'}")
    assert usual_storage() == "optuna.journal"
    assert address_of("storage") == "postgresql://me@host/db"
    assert address_of("tracking_uri") == "postgresql://me@host/runs"
    assert [os.environ.get(name) for name in PASSWORDS] == ["secret", "hidden", None]


def test_passwords_of_the_local_file_serve_every_command_where_none_are_set(write_local, monkeypatch):
    write_local("storage: postgresql://me:secret@host/db")
    hand_over_local()
    assert os.environ[passwords.STORAGE_PASSWORD] == "secret"
    monkeypatch.setenv(passwords.STORAGE_PASSWORD, "other")
    hand_over_local()
    assert os.environ[passwords.STORAGE_PASSWORD] == "other"


def test_empty_local_file_says_nothing(write_local):
    write_local("# storage: postgresql://me@host/db\n")
    assert local_addresses() == {}


def test_service_that_nobody_has_named_is_told_with_where_to_name_it():
    with pytest.raises(InvalidValueError, match=r"neither ARMSCAN_STORAGE is set nor is there a storage in conf/local"):
        address_of("storage")


@pytest.mark.parametrize(
    ("contents", "answer"),
    [
        ("storage: [secret", "cannot be read: ParserError"),
        ("secret", "must hold nothing but storage or tracking_uri, each with an address"),
        ("storage: {a: secret}", "must hold nothing but storage or tracking_uri, each with an address"),
        ("password: secret", "has 'password', but it must hold nothing but storage or tracking_uri"),
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
    assert password_of("ARMSCAN_STORAGE_PASSWORD") == "a b"
    (tmp_path / "empty").write_text("\n")
    (tmp_path / "binary").write_bytes(b"\xff")
    for name, reason in (("empty", "is empty"), ("binary", "it is no text")):
        monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD_FILE", str(tmp_path / name))
        with pytest.raises(InvalidValueError, match=f"ARMSCAN_STORAGE_PASSWORD_FILE is .*{name}.*{reason}"):
            password_of("ARMSCAN_STORAGE_PASSWORD")
    monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD_FILE", str(tmp_path / "nothing"))
    with pytest.raises(InvalidValueError, match=r"ARMSCAN_STORAGE_PASSWORD_FILE is .*nothing', but it cannot be read"):
        password_of("ARMSCAN_STORAGE_PASSWORD")


def test_words_with_a_password_are_refused_and_others_are_not():
    check_words(["a=b", "storage=postgresql://me@host/db", "x=http://host/a?b=c", "a:b@c"])
    with pytest.raises(InvalidValueError, match=r"storage has a password.*: set ARMSCAN_STORAGE_PASSWORD, or"):
        check_words(["storage='postgresql://me:secret@host/db'"])


def test_masked_text_has_no_password(monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE_PASSWORD", "secret")
    assert masked("http://a:b@c: secret and postgresql://d@e") == "http://a:***@c: *** and postgresql://d@e"


def test_configuration_resolves_to_addresses_without_passwords(monkeypatch):
    monkeypatch.setenv("ARMSCAN_STORAGE", "postgresql://me:secret@host/db")
    config = OmegaConf.create({"storage": "${armscan.service:storage}"})
    assert OmegaConf.to_yaml(config, resolve=True) == "storage: postgresql://me@host/db\n"
