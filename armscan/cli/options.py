"""Shared by the commands: exit codes and errors, types of values, options."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import click

from armscan.config.credentials import check_address
from armscan.errors import InvalidValueError, is_interruption, listed

TRACEBACKS = "ARMSCAN_TRACEBACKS"
AGE = re.compile(r"(\d+(?:\.\d+)?)([mhdw])")
UNITS = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}


class Interrupted(click.ClickException):
    """A command was interrupted; the message says what it leaves behind."""

    exit_code = 130


class Command(click.Command):
    """A command with examples, that says what an interrupt leaves behind.

    Args:
        left: told after an interrupt, such as "nothing was written".
        examples: command lines, without the name of the program.
        *args: those of `click.Command`.
        **kwargs: likewise.
    """

    def __init__(self, *args: Any, left: str, examples: Collection[str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._left, self.examples = left, examples

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, a line each."""
        with formatter.section("Examples"):
            for example in self.examples:
                formatter.write(f"{'':>{formatter.current_indent}}{ctx.find_root().info_name} {example}\n")

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Keep the arguments as they were typed, for hints."""
        ctx.obj = tuple(args)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except (KeyboardInterrupt, Exception) as error:
            if is_interruption(error):
                raise Interrupted(f"interrupted; {self._left}") from error
            raise


class UriParam(click.ParamType[str]):
    """The address of a store; without a password, which everybody on this machine could read."""

    name = "URI"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the address.

        Raises:
            InvalidValueError: if it holds a password.
        """
        if not value:
            self.fail("an address is required.", param, ctx)
        check_address(param.opts[0] if param else self.name, value)
        return value


class FilePath(click.ParamType[Path]):
    """A file or folder, which need not exist.

    Args:
        name: placeholder of the value in the help text.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def convert(self, value: str | Path, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path."""
        return Path(value) if value else self.fail("a path is required.", param, ctx)


class CommaSeparated(click.ParamType[tuple[str, ...]]):
    """Values separated by commas.

    Args:
        metavar: placeholder of the value in the help text.
        choices: the values allowed. Default: any but an empty one.
    """

    name = "list"

    def __init__(self, metavar: str, choices: Collection[str] = ()) -> None:
        self._metavar, self._choices = metavar, choices

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """Return how help names the value."""
        return f"{self._metavar},..."

    def convert(
        self, value: str | tuple[str, ...], param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Return the values."""
        parts = value if isinstance(value, tuple) else tuple(part.strip() for part in value.split(","))
        for part in parts:
            if self._choices and part not in self._choices:
                self.fail(f"{part!r} is not {listed(self._choices)}.", param, ctx)
            if not part:
                self.fail(f"{value!r} has an empty part.", param, ctx)
        return parts


class Moment(click.ParamType[datetime]):
    """An age such as 7d, or a date such as 2026-01-31, with or without a time."""

    name = "AGE|DATE"

    def convert(self, value: str | datetime, param: click.Parameter | None, ctx: click.Context | None) -> datetime:
        """Return the moment."""
        if isinstance(value, datetime):
            return value
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


def _usual_tracking() -> str:
    from armscan.config.defaults import default_tracking

    return str(default_tracking()["uri"])


def _usual_storage() -> str:
    from armscan.config.defaults import default_storage

    return default_storage()


def tracking_option(what: str = "MLflow tracking store.") -> Callable[[Any], Any]:
    """Return the option `--tracking`."""
    return click.option(
        "--tracking",
        type=UriParam(),
        default=_usual_tracking,
        show_default="MLFLOW_TRACKING_URI or sqlite:///mlruns.db",
        help=what,
    )


def storage_option(what: str = "Optuna storage of the studies.") -> Callable[[Any], Any]:
    """Return the option `--storage`."""
    return click.option(
        "--storage",
        type=UriParam(),
        default=_usual_storage,
        show_default="ARMSCAN_STORAGE or optuna.journal",
        help=what,
    )


def clustering_option() -> Callable[[Any], Any]:
    """Return the option `--clustering`."""
    return click.option(
        "--clustering",
        type=click.Choice(["pixels", "metric"]),
        help="How landmarks are clustered: by pixels, or by mm for volumes whose pixels are not about 0.27 x 0.55 mm.",
    )


@contextlib.contextmanager
def one_line(overrides: Sequence[str]) -> Iterator[None]:
    """Raise mistakes in a configuration that is composed of these overrides as `InvalidValueError`."""
    try:
        yield
    except Exception as error:
        # Deferred: it loads Hydra.
        from armscan.config.error_messages import one_line_message

        line = one_line_message(error, overrides)
        if line is None or os.environ.get(TRACEBACKS):
            raise
        raise InvalidValueError(line) from error


def is_given(name: str) -> bool:
    """Whether an option of the current command was given on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE
