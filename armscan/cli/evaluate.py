"""`armscan evaluate`: metrics or a video of an agent on any volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from armscan.cli.options import (
    FILE_PATH,
    allow_imports_from_working_folder,
    clustering_option,
    examples,
    is_given,
    tracking_option,
    trust_option,
)
from armscan.config.defaults import CHANGES, PHANTOM, default_tracking
from armscan.errors import InvalidValueError
from armscan.stats.on_plane import ON_PLANE_KEY
from armscan.utils.console import wide_console
from armscan.utils.processes import end_like_ctrl_c
from armscan.utils.validation import MAX_SEED

if TYPE_CHECKING:
    from armscan.evaluation.runner import PreparedAgent
    from armscan.evaluation.volumes import VolumesByName

N_EPISODES, N_VIDEO_EPISODES = 200, 3
# Overrides of `armscan run` that are options here.
OPTIONS = {
    "agent": "--agent NAME",
    "tracking.uri": "--tracking URI",
    "tracking.experiment": "--tracking-experiment NAME",
    "evaluation.episodes": "--episodes NUMBER",
    "seed": "--seed NUMBER",
}


@click.command(
    epilog=examples(
        "evaluate 3bf2",
        "evaluate 3bf2 --data wrists --success-threshold 0.01",
        "evaluate 3bf2 --data phantom --phantoms 12 --video",
        "evaluate --agent random --data wrists projection=zy",
    ),
)
@click.argument("run", nargs=-1, metavar="[RUN | KEY=VALUE...]")
@click.option("--agent", metavar="NAME", help="Evaluate an agent that needs no training instead of a run's.")
@click.option(
    "--data",
    metavar="FOLDER|phantom",
    help="Volumes: a folder, or phantoms that no run trains on.  [default: the agent's own]",
)
@click.option("--phantoms", type=click.IntRange(1, 10_000), default=8, help="Number of phantoms, for --data phantom.")
@click.option(
    "--episodes",
    type=click.IntRange(1),
    show_default=f"{N_EPISODES}; {N_VIDEO_EPISODES} with --video",
    help="Number of episodes on each split; they cycle through its volumes.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, MAX_SEED),
    default=0,
    help="Seed of the episodes; all agents play the same ones.",
)
@click.option("--video", is_flag=True, help="Record the episodes as GIF and MP4 instead; nothing is tracked.")
@click.option(
    "--out",
    type=FILE_PATH,
    metavar="PATH",
    help="JSON file of metrics and episodes, or folder of the video.  [default: in evaluations or videos]",
)
@click.option(
    "--success-threshold",
    type=click.FloatRange(0, 1, min_open=True),
    help="Threshold of success: an episode succeeds if its reward is above minus this value.",
)
@click.option("--max-steps", type=click.IntRange(1), help="Steps after which an episode is truncated.")
@click.option("--start", type=click.Choice(["middle", "random"]), help="Where episodes start.")
@clustering_option
@click.option(
    "--deterministic-eval/--no-deterministic-eval",
    default=None,
    help="Take the policy's deterministic action, or sample its actions.",
)
@click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), help="Device on which the network computes.")
@tracking_option(help="MLflow tracking store of the run and of the evaluation.")
@click.option(
    "--tracking-experiment",
    metavar="NAME",
    help="MLflow experiment of the evaluation, with --agent; that of a run is the run's own.",
)
@trust_option
def evaluate(
    run: tuple[str, ...],
    agent: str | None,
    data: str | None,
    phantoms: int,
    episodes: int | None,
    seed: int,
    video: bool,
    out: Path | None,
    tracking: str,
    tracking_experiment: str | None,
    trust: bool,
    **rules: Any,
) -> None:
    """Evaluate or record an agent on any volumes.

    RUN is an MLflow run ID or its first characters. With --agent, any KEY=VALUE of armscan run configures
    the agent instead, experiment=PRESET included.

    By default, the rules of the episodes and the device are the agent's own. docs/metrics.md explains the metrics,
    docs/seeing.md the video.
    """
    # As in `armscan run`: the evaluation's run is closed as KILLED.
    end_like_ctrl_c()
    changes = {name: value for name, value in rules.items() if value is not None}
    _check_arguments(run, agent, data, changes)
    _check_options(agent, data, tracking_experiment, video=video)
    folder = None if data == PHANTOM else data
    print(f"preparing {f'run {run[0]}' if agent is None else f'agent={agent}'}", flush=True)
    # Deferred: command-line errors are reported before these are loaded.
    from armscan import evaluation
    from armscan.evaluation.runner import prepare_agent
    from armscan.experiment.job import check_choices

    if agent is None:
        source = evaluation.agent_of_run(tracking, run[0], changes, trust=trust)
    else:
        allow_imports_from_working_folder()
        overrides = [f"agent={agent}", *run, *(["data=nifti"] if folder else [])]
        check_choices(overrides)
        source = evaluation.agent_of_overrides(overrides, folder, changes)
    n_episodes = episodes or (N_VIDEO_EPISODES if video else N_EPISODES)
    if video:
        _record(prepare_agent(source, data, phantoms, render_mode="rgb_array"), n_episodes, seed, out)
    else:
        prepared = prepare_agent(source, data, phantoms, check=lambda groups: _check_episodes(n_episodes, groups))
        experiment = {} if tracking_experiment is None else {"experiment": tracking_experiment}
        _evaluate(prepared, default_tracking() | {"uri": tracking} | experiment, n_episodes, seed, out)


def _record(prepared: PreparedAgent, n_episodes: int, seed: int, out: Path | None) -> None:
    """Record a video, and print where it is."""
    from armscan.evaluation.video import record_video
    from armscan.experiment.console import path_to_type

    for file in record_video(prepared, n_episodes=n_episodes, seed=seed, out=out):
        print(f"look at   {path_to_type(file)}")


def _evaluate(
    prepared: PreparedAgent,
    store: Mapping[str, Any],
    n_episodes: int,
    seed: int,
    out: Path | None,
) -> None:
    """Evaluate an agent, track its metrics, and print them."""
    from armscan.evaluation import report_tables
    from armscan.evaluation.track import evaluate_and_track, notes_on, notes_on_rules
    from armscan.experiment.console import print_result_table, print_where_to_look

    report, file = evaluate_and_track(prepared, store, n_episodes=n_episodes, seed=seed, out=out)
    console = wide_console()
    for part in report_tables(report, console.width):
        console.print(part)
    tables = report.tables()
    for label, table in tables.items():
        notes = [*notes_on_rules(prepared.source), *notes_on(prepared, report, label)]
        print_result_table(label, table, notes, how=label == [*tables][-1], of=label)
    print_where_to_look(Path.cwd(), store["uri"], files=(str(file),))


def _check_options(agent: str | None, data: str | None, tracking_experiment: str | None, *, video: bool) -> None:
    """Raise an error if options exclude each other, or the folder does not exist."""
    if is_given("phantoms") and data != PHANTOM:
        number = click.get_current_context().params["phantoms"]
        raise click.UsageError(f"--phantoms is {number}, but it requires --data phantom")
    if tracking_experiment is not None and (agent is None or video):
        raise click.UsageError(
            "--tracking-experiment is for --agent without --video: the evaluation of a run is tracked in the run's "
            "own experiment, a video not at all"
        )
    if data not in (None, PHANTOM) and not Path(str(data)).is_dir():
        what = "that is a file" if Path(str(data)).exists() else "there is no such folder"
        raise InvalidValueError(f"--data is {data!r}, but {what}: it must be a folder of volumes, or phantom")


def _check_arguments(run: Sequence[str], agent: str | None, data: str | None, changes: Mapping[str, Any]) -> None:
    """Raise an error unless there is one run or an agent, with no override that is an option here."""
    if agent is None:
        if any("=" in override for override in run):
            raise click.UsageError(f"{' '.join(run)!r} configures an agent: give --agent NAME with it, or RUN alone")
        if len(run) != 1:
            raise click.UsageError("give one RUN, or --agent NAME")
        return
    given = {CHANGES[name]: f"--{name.replace('_', '-')}" for name in changes}
    given |= dict.fromkeys(("data", "data.path"), "--data") if data is not None else {}
    for override in run:
        key = override.partition("=")[0].lstrip("+~")
        if key != ON_PLANE_KEY and (key in OPTIONS or key.startswith(("tracking.", "evaluation."))):
            instead = f"give {OPTIONS[key]}" if key in OPTIONS else "see armscan evaluate --help"
            raise click.UsageError(f"{key} cannot be set here: {instead}")
        if key in given:
            raise click.UsageError(f"{given[key]} and {key} are both given, but they are one value: give one of them")


def _check_episodes(n_episodes: int, groups: Mapping[str, VolumesByName]) -> None:
    for label, volumes in groups.items():
        if n_episodes < len(volumes):
            least = f"at least {len(volumes)}: one for each of the {label}"
            raise InvalidValueError(f"--episodes is {n_episodes}, but it must be {least}")
