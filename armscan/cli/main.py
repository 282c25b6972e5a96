"""The program `armscan`: its commands, and how mistakes and interrupts end it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from armscan.cli.data import data
from armscan.cli.evaluate import evaluate
from armscan.cli.options import allow_imports_from_working_folder
from armscan.cli.policy import policy
from armscan.cli.report import report
from armscan.cli.runs import runs
from armscan.cli.ui import ui
from armscan.errors import in_one_line, is_interruption, print_error
from armscan.utils.log import silence_libraries
from armscan.utils.processes import EXIT_INTERRUPTED, collect_garbage_rarely, discard_output

PROGRAM = "armscan"


class PassedOn(click.Command):
    """A command that receives its arguments unparsed, options included."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Keep the arguments for the command."""
        ctx.args = args
        return args


@click.command(cls=PassedOn, add_help_option=False)
@click.pass_context
def run(ctx: click.Context) -> int:
    """Train an agent, or run a grid or a study (Hydra).

    Same as python -m armscan.run.
    """
    from armscan.run import main

    allow_imports_from_working_folder()
    sys.argv[1:] = ctx.args
    return main()


@click.group(
    commands=(run, evaluate, runs, policy, report, ui, data),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120, "show_default": True},
)
@click.version_option(package_name="armscan")
def armscan() -> None:
    """Train and evaluate agents that find the carpal tunnel's plane in labelmaps of the wrist.

    armscan COMMAND --help explains a command.
    """


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; report a user's mistake in one line.

    Args:
        arguments: Arguments of the command line. Default: those of this process.

    Returns:
        The exit code: 2 for a mistake, 130 for an interrupt, else the command's own.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    collect_garbage_rarely()
    silence_libraries()
    try:
        return armscan.main(arguments, prog_name=PROGRAM, standalone_mode=False, obj=arguments) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return error.exit_code
    except click.ClickException as error:
        print_error(in_one_line(error.format_message()))
        return error.exit_code
    except BrokenPipeError:
        discard_output()
        return 1
    except Exception as error:
        if is_interruption(error):
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        # Deferred: it loads Hydra.
        from armscan.config.error_messages import print_mistake

        if not print_mistake(error):
            raise
        return 2
