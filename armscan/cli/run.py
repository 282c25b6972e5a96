"""`armscan run`: the command line of Hydra, passed on untouched."""

from __future__ import annotations

import sys

import click


class PassedOn(click.Command):
    """A command that takes its arguments as they are, options included."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Keep the arguments for the command."""
        ctx.args = args
        return args


@click.command(cls=PassedOn, add_help_option=False)
@click.pass_context
def run(ctx: click.Context) -> int:
    """Train an agent, run a sweep or a study (Hydra).

    Same as python -m armscan.run.
    """
    from armscan.run import main

    sys.argv[1:] = ctx.args
    return main()
