"""Parameter types, options and examples that the commands share."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import click

from armscan.config.credentials import check_address
from armscan.config.defaults import default_storage, default_tracking
from armscan.errors import listed

AGE = re.compile(r"(\d+(?:\.\d+)?)([mhdw])")
UNITS = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}


def examples(*lines: str) -> str:
    """Return the epilog of a command's help: command lines, each given without the name of the program."""
    return "\n".join(("\b\nExamples:", *(f"  armscan {line}" for line in lines)))


class FilePath(click.ParamType[Path]):
    """A path that is not empty: an unset shell variable would otherwise mean the working folder."""

    name = "path"

    def convert(self, value: str | Path, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path."""
        if not value:
            self.fail("a path is required.", param, ctx)
        return Path(value)


FILE_PATH = FilePath()


class UriParam(click.ParamType[str]):
    """The address of a store, without a password: every user of this machine can read command lines."""

    name = "URI"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the address; raise `InvalidValueError` if it holds a password."""
        if not value:
            self.fail("an address is required.", param, ctx)
        check_address(param.opts[0] if param else self.name, value)
        return value


class CommaSeparated(click.ParamType[tuple[str, ...]]):
    """Values separated by commas.

    Args:
        metavar: Placeholder of the value in the help text.
        choices: Allowed values. Default: any non-empty value.
    """

    name = "list"

    def __init__(self, metavar: str, choices: Collection[str] = ()) -> None:
        self._metavar, self._choices = metavar, choices

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return the placeholder that help shows."""
        return f"{self._metavar},..."

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Return the values."""
        parts = tuple(part.strip() for part in value.split(","))
        for part in parts:
            if self._choices and part not in self._choices:
                self.fail(f"{part!r} is not {listed(self._choices)}.", param, ctx)
            if not part:
                self.fail(f"{value!r} has an empty part.", param, ctx)
        return parts


class Moment(click.ParamType[datetime]):
    """An age such as 7d, or a date such as 2026-01-31, with or without a time."""

    name = "AGE|DATE"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> datetime:
        """Return the moment."""
        try:
            if age := AGE.fullmatch(value):
                return datetime.now().astimezone() - timedelta(**{UNITS[age[2]]: float(age[1])})
            return datetime.fromisoformat(value).astimezone()
        except (ValueError, OverflowError):
            self.fail(
                f"{value!r} is neither an age such as 90m, 12h, 7d or 4w, nor a date such as 2026-01-31 or "
                "2026-01-31T18:00.",
                param,
                ctx,
            )


tracking_option = partial(
    click.option,
    "--tracking",
    type=UriParam(),
    default=lambda: str(default_tracking()["uri"]),
    show_default="MLFLOW_TRACKING_URI or sqlite:///mlruns.db",
    help="MLflow tracking store.",
)
storage_option = partial(
    click.option,
    "--storage",
    type=UriParam(),
    default=default_storage,
    show_default="ARMSCAN_STORAGE or optuna.journal",
    help="Optuna storage of the studies.",
)


def allow_imports_from_working_folder() -> None:
    """Allow imports of the user's own classes from the current folder, as `python -m` does."""
    sys.path.insert(0, str(Path.cwd()))


def _trusting(ctx: click.Context, option: click.Parameter, trust: bool) -> bool:
    if trust:
        allow_imports_from_working_folder()
    return trust


trust_option = click.option(
    "--trust",
    is_flag=True,
    callback=_trusting,
    help="Trust the author of the run: execute code and read files that it names.",
)
clustering_option = click.option(
    "--clustering",
    type=click.Choice(["pixels", "metric"]),
    help="How landmarks are clustered: by pixels, tuned to 0.27 x 0.55 mm, or by mm, for pixels of at most 0.6 mm.",
)


def is_given(name: str) -> bool:
    """Return whether an option of the current command was given on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE
