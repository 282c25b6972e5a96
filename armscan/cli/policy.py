"""`armscan policy`: the policy of a run as an MLflow and ONNX model."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from armscan.cli.options import FILE_PATH, examples, tracking_option, trust_option
from armscan.config.command_hints import typed
from armscan.errors import InvalidValueError


@click.group()
def policy() -> None:
    """Export or register the policy of a run."""


@policy.command(epilog=examples("policy export 3bf2 --out wrist-model"))
@click.argument("run")
@click.option(
    "--out",
    type=FILE_PATH,
    metavar="FOLDER",
    required=True,
    help="Folder of the model. An exported model there is replaced, nothing else.",
)
@tracking_option()
@trust_option
def export(run: str, out: Path, tracking: str, trust: bool) -> None:
    """Export the policy of RUN as an MLflow and ONNX model.

    RUN is an MLflow run ID or its first characters. The model is made from the checkpoint of the run;
    docs/policy.md describes its input and output.
    """
    # Deferred: command-line errors are reported before these are loaded.
    from armscan.policies.model import is_model, others_in
    from armscan.runs.policy_registry import export_policy

    if out.exists() and not is_model(out):
        raise InvalidValueError(f"--out is {str(out)!r}, but something else is there, and would be lost: name another")
    if out.exists() and (others := others_in(out)):
        raise InvalidValueError(f"--out is {str(out)!r}, but {others[0]!r} is in it, and would be lost: name another")
    export_policy(tracking, run, out, trust=trust)
    print(f"exported   {out}")
    _print_usage(str(out))


@policy.command(epilog=examples("policy register 3bf2 --name wrist"))
@click.argument("run")
@click.option("--name", required=True, help="Name of the registered model, which is created if there is none.")
@tracking_option(help="MLflow tracking store; its model registry is used.")
@trust_option
def register(run: str, name: str, tracking: str, trust: bool) -> None:
    """Register the policy of RUN in MLflow's model registry.

    RUN is an MLflow run ID or its first characters. Each call registers a new version, which gets
    the alias champion: models:/NAME@champion.
    """
    from armscan.runs.policy_registry import register_policy

    address = register_policy(tracking, run, name, trust=trust)
    print(f"registered {address}")
    print(f"its store  export MLFLOW_TRACKING_URI={shlex.quote(tracking)}")
    _print_usage(address)


def _print_usage(address: str) -> None:
    print(f"load it    mlflow.pyfunc.load_model({address!r}).predict(observations)")
    serve = shlex.join([*typed("mlflow"), "models", "serve", "-m", address, "--env-manager", "local"])
    print(f"serve it   {serve}")
