"""The command `python -m armscan.policy`: the policy that a run has trained, as a model for MLflow and as ONNX.

    python -m armscan.policy export run=ID out=FOLDER       makes the model from the run's checkpoint
    python -m armscan.policy register run=ID name=NAME      a new version of a model in MLflow's registry

run=ID              the run's id, or its first four or more characters, as the UI shows them
out=FOLDER          takes the model; a model that was made so is replaced, and nothing else
name=NAME           of the registered model, which is made where there is none
tracking=URI        the store, MLFLOW_TRACKING_URI or sqlite:///mlruns.db where nothing is said; its registry, too

docs/policy.md says what goes in and what comes out.
"""

from __future__ import annotations

import os
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
    from armscan.policies.making import is_model
    from armscan.policies.registry import export_policy

    if out.exists() and not is_model(out) and not (out.is_dir() and not any(out.iterdir())):
        raise InvalidValueError(f"out is {str(out)!r}, but something else is there, and would be lost: name another")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidValueError(f"out is {str(out)!r}, but no folder can be made there: {error.strerror}") from error
    export_policy(tracking, run, out)
    _tell(str(out), "exported")


def _register(tracking: str, run: str, name: str) -> None:
    from armscan.passwords import without_password
    from armscan.policies.registry import register_policy

    address = register_policy(tracking, run, name)
    _tell(address, "registered")
    print(f"from elsewhere, with MLFLOW_TRACKING_URI={without_password(tracking)}")


def _tell(where: str, done: str) -> None:
    print(f"{done:10} {where}")
    print(f"load it    mlflow.pyfunc.load_model({where!r}).predict(observations)")
    print(f"serve it   mlflow models serve -m {where} --env-manager local")


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
            raise InvalidValueError(
                f"{key} is not set, but it must be: give {command} run=ID {keys[1]}=... (--help explains)"
            )
    return command, values


if __name__ == "__main__":
    sys.exit(main())
