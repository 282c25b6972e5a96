"""Arguments of the scripts: each has `--help`, and a wrong argument ends it in one line."""

from __future__ import annotations

import argparse
import inspect
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.repository import VOLUMES

if TYPE_CHECKING:
    from armscan.volumes import LabelVolume


def run_script(main: Callable[[], None]) -> None:
    """Run a script; a mistake of the user ends it in one line, as in armscan's commands."""
    try:
        main()
    except Exception as error:
        # Scripts set the number of threads before they import anything that starts them.
        from armscan.config.error_messages import print_mistake

        if not print_mistake(error):
            raise
        sys.exit(2)


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help begins with the text at the head of a script."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def count(text: str) -> int:
    """Return a number of things, 1 or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


def new_file(text: str) -> Path:
    """Return a file to be written, whose folder exists."""
    if not (file := Path(text)).parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text} cannot be written: there is no folder {file.parent}")
    return file


def labelmaps(text: str) -> dict[str, LabelVolume]:
    """Return the volumes of a folder by name."""
    from armscan.errors import InvalidValueError
    from armscan.volumes import read_dataset

    try:
        return read_dataset(text)
    except InvalidValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def given_volumes(description: str | None) -> dict[str, LabelVolume]:
    """Return the volumes of the folder that is a script's only argument; without one, those of the tests."""
    parser = parser_of(description)
    parser.add_argument("volumes", metavar="FOLDER", type=labelmaps, nargs="?", default=str(VOLUMES), help="labelmaps")
    return parser.parse_args().volumes


def add_options_of(parser: argparse.ArgumentParser, function: Callable[..., None]) -> None:
    """Add an option for each keyword argument of a function that has a default; a tuple takes several values."""
    parser.add_argument("--folder", type=Path, help="folder of the results (default: a temporary folder)")
    for name, each in inspect.signature(function).parameters.items():
        if each.kind is inspect.Parameter.KEYWORD_ONLY:
            several = isinstance(each.default, tuple)
            parser.add_argument(
                f"--{name.replace('_', '-')}",
                type=type(each.default[0] if several else each.default),
                nargs="+" if several else None,
                default=each.default,
                help="default: %(default)s",
            )


def call(function: Callable[..., None], given: argparse.Namespace) -> None:
    """Call a function with the folder and the options that `add_options_of` added."""
    options: dict[str, Any] = vars(given)
    folder = (options.pop("folder") or Path(tempfile.mkdtemp())).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    print(f"folder: {folder}", file=sys.stderr)
    function(folder, **options)
