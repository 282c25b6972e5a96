"""The command `python -m armscan.policy`: the policy that a run has trained, as a model for MLflow and as ONNX.

    python -m armscan.policy export run=ID out=FOLDER       makes the model from the run's checkpoint
    python -m armscan.policy register run=ID name=NAME      a new version of a model in MLflow's registry

run=ID              the run's id, or its first four or more characters, as the UI shows them
out=FOLDER          takes the model; a model of ours is replaced, and nothing else
name=NAME           of the registered model, which is made where there is none
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said; its registry, too

docs/policy.md says what goes in and what comes out.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from armscan.errors import InvalidValueError, listed
from armscan.mistakes import quieten_libraries
from armscan.settings import usual_tracking
from armscan.words import answered, read_words

# Of each of its commands, what it must be given beside the run.
COMMANDS = {"export": "out", "register": "name"}


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="nothing was exported or registered")


def _run(words: Sequence[str]) -> int:
    command, values = _read(words)
    quieten_libraries()
    tracking = values.get("tracking", usual_tracking()["uri"])
    if command == "export":
        _export(tracking, values["run"], Path(values["out"]))
    else:
        _register(tracking, values["run"], values["name"])
    return 0


def _export(tracking: str, run: str, out: Path) -> None:
    # Deferred: a mistake on the command line should be answered before these are loaded.
    from armscan.policies.model import is_model, others_in
    from armscan.policies.registry import export_policy

    if out.exists() and not is_model(out):
        raise InvalidValueError(f"out is {str(out)!r}, but something else is there, and would be lost: name another")
    if out.exists() and (others := others_in(out)):
        raise InvalidValueError(f"out is {str(out)!r}, but {others[0]!r} is in it, and would be lost: name another")
    export_policy(tracking, run, out)
    print(f"exported   {out}")
    _tell_how_to_use(str(out))


def _register(tracking: str, run: str, name: str) -> None:
    from armscan.passwords import without_password
    from armscan.policies.registry import register_policy

    address = register_policy(tracking, run, name)
    print(f"registered {address}")
    print(f"its store  export MLFLOW_TRACKING_URI={shlex.quote(without_password(tracking))}")
    _tell_how_to_use(address)


def _tell_how_to_use(where: str) -> None:
    print(f"load it    mlflow.pyfunc.load_model({where!r}).predict(observations)")
    print(f"serve it   mlflow models serve -m {shlex.quote(where)} --env-manager local")


def _read(words: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Returns the command and its values."""
    plain = [word for word in words if "=" not in word]
    if len(plain) != 1 or plain[0] not in COMMANDS:
        given = " ".join(words) or "nothing"
        raise InvalidValueError(f"{given!r} cannot be read: give {listed(COMMANDS)}, and run=ID (--help explains)")
    command = plain[0]
    keys = ("run", COMMANDS[command], "tracking")
    values = read_words([word for word in words if "=" in word], keys, keys)
    for key in keys[:2]:
        if key not in values:
            raise InvalidValueError(f"{key} is not set, but it must be: give {key}=... (--help explains)")
    return command, values


if __name__ == "__main__":
    sys.exit(main())
