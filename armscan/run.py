"""The command `python -m armscan.run`: one run, or with -m several side by side.

The configuration is read here and in `building.py`: everything is built from it there, and no part of it goes further.
"""

from __future__ import annotations

import os

# One compute thread a process, set before any library starts its pool: small networks are fastest so, and jobs side by
# side never claim more threads than there are cores.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from armscan.errors import is_interruption
from armscan.files import LAST_CHECKPOINT
from armscan.mistakes import mistake_in_one_line, quieten_libraries
from armscan.multirun import INTERRUPTED, NO_OUTCOME, Job, end_multirun, remove_run_folder

if TYPE_CHECKING:
    from armscan.tracking import TrackedRun
    from armscan.training import Familiar, Split

MAX_TAG_CHARS = 5000
CHOICES_IN_TAGS = ("data", "obs", "reward", "agent", "network")
WANTS_TRACEBACKS = "ARMSCAN_TRACEBACKS"
# What a job's process runs; it may be interrupted while it is still importing.
JOB_PROGRAM = """
try:
    from armscan.run import run_job
    run_job()
except KeyboardInterrupt:
    raise SystemExit(130)
"""
# First seeds of the episodes that are played for each purpose, so that none is played for two.
VALIDATION_SEED, TRAINING_VOLUMES_SEED, TEST_VOLUMES_SEED, FILM_SEED = 10**6, 2 * 10**6, 3 * 10**6, 4 * 10**6


@dataclass(frozen=True)
class Invocation:
    """How a run was asked for.

    Args:
        folder: where it leaves its files.
        overrides: of the command line.
        choices: what was chosen of each configuration group.
        job: which one of a multirun it is, None for a single run.
    """

    folder: Path
    overrides: list[str]
    choices: dict[str, str]
    job: Job | None

    @classmethod
    def current(cls) -> Invocation:
        """Returns how Hydra is running this process."""
        hydra_config = HydraConfig.get()
        return cls(
            folder=Path(hydra_config.runtime.output_dir),
            overrides=list(hydra_config.overrides.task),
            choices={str(group): str(choice) for group, choice in hydra_config.runtime.choices.items()},
            job=Job.current(),
        )


def run_experiment(config: DictConfig, invocation: Invocation) -> dict[str, dict[str, float]]:
    """Trains an agent, if it is one that learns, evaluates and tracks it.

    Args:
        config: the composed configuration.
        invocation: how it was asked for.

    Returns:
        The figures of the final evaluations, by the name of their volumes.
    """
    # Deferred: a mistake on the command line should be answered before these are loaded.
    import torch

    from armscan.agents import Learner
    from armscan.building import build
    from armscan.console import print_results, print_where_to_look, progress_reporter
    from armscan.training import TEST, TRAINING, Familiar, evaluate, film_episode, train

    quieten_libraries()
    torch.set_num_threads(1)
    folder, job = invocation.folder, invocation.job
    # Everything is built, and so checked, before anything is tracked.
    experiment = build(config)
    split, maker, agent, seed = experiment.split, experiment.maker, experiment.agent, experiment.seed
    training_env, validation_env, test_env = map(maker.one, (split.training, split.validation, split.test))
    film_env = maker.one(split.test, render_mode="rgb_array")

    with tracked_run(config, invocation, split, Familiar.of(training_env)) as tracked:
        result = None
        if isinstance(agent, Learner):
            n_episodes, budget = experiment.budget.validation_episodes, experiment.budget
            validate = partial(evaluate, agent, validation_env, n_episodes=n_episodes, seed=VALIDATION_SEED + seed)
            progress = progress_reporter(job.label if job else None)
            result = train(agent, budget, validate, folder, callbacks=[progress, tracked])
        evaluations = {
            TRAINING: evaluate(
                agent, training_env, n_episodes=experiment.n_episodes, seed=TRAINING_VOLUMES_SEED + seed
            ),
            TEST: evaluate(agent, test_env, n_episodes=experiment.n_episodes, seed=TEST_VOLUMES_SEED + seed),
        }
        film_episode(agent, film_env, folder / "episode.gif", seed=FILM_SEED + seed)
        tracked.keep_results(result, evaluations, folder)
    if job is None:
        how = f"deterministic policy, as it was after {result.best.n_env_steps} steps" if result else "nothing to learn"
        print_results(f"results ({how})", evaluations)
        files = ("learning_curve.png", "episode.gif") if result else ("episode.gif",)
        print_where_to_look(folder, config.tracking.uri, files=files)
    return {name: evaluation.metrics() for name, evaluation in evaluations.items()}


def tracked_run(config: DictConfig, invocation: Invocation, split: Split, familiar: Familiar) -> TrackedRun:
    """Opens the tracking store and starts a run in it."""
    from armscan.tracking import FAMILIAR_TAG, TrackedRun, open_store

    resolved: dict[str, Any] = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    client, experiment_id = open_store(**resolved["tracking"])
    choices = invocation.choices
    return TrackedRun(
        client,
        experiment_id,
        name=run_name(resolved, choices),
        config=resolved,
        tags={
            "overrides": " ".join(invocation.overrides),
            **{f"choice.{group}": choices[group] for group in CHOICES_IN_TAGS},
            "volumes.training": " ".join(split.training)[:MAX_TAG_CHARS],
            "volumes.validation": " ".join(split.validation)[:MAX_TAG_CHARS],
            "volumes.test": " ".join(split.test)[:MAX_TAG_CHARS],
            # Where it is applied to other volumes, later, the agent must see what it has learned to see.
            FAMILIAR_TAG: familiar.to_json(),
        },
        parent_id=invocation.job.parent_run_id if invocation.job else None,
    )


def run_name(config: dict[str, Any], choices: dict[str, str]) -> str:
    """Returns what the UI calls a run: what most runs differ by."""
    projection = config["projection"]
    parts = [choices["agent"], choices["obs"], projection if isinstance(projection, str) else "+".join(projection)]
    parts += [
        f"{wrapper}{config[wrapper]}"
        for wrapper, without in (("stack", 1), ("memory", 0))
        if config[wrapper] != without
    ]
    return "-".join([*parts, choices["data"], f"seed{config['seed']}"])


def run(config: DictConfig) -> None:
    """What Hydra calls: a single run, or one job of a multirun in a process of its own."""
    invocation = Invocation.current()
    if invocation.job is None:
        print(f"preparing data={invocation.choices['data']}, agent={invocation.choices['agent']}", flush=True)
        try:
            run_experiment(config, invocation)
        except KeyboardInterrupt:
            remove_if_empty(invocation.folder)
            raise
        except Exception as error:
            remove_if_empty(invocation.folder)
            if is_interruption(error):
                raise KeyboardInterrupt from error
            raise_or_exit(error)
    else:
        # A job that is killed, for its memory say, takes neither the launcher nor the other jobs with it.
        invocation.job.write_outcome(failure=NO_OUTCOME)
        ended = subprocess.run(
            [sys.executable, "-c", JOB_PROGRAM], input=pickle.dumps((config, invocation)), check=False
        )
        if ended.returncode < 0:
            invocation.job.write_outcome(failure=f"killed by {signal.Signals(-ended.returncode).name}: out of memory?")


def run_job() -> None:
    """One job of a multirun, handed over on standard input: a failure is noted, and does not stop the others."""
    threading.Thread(target=leave_with_parent, args=(os.getppid(),), daemon=True).start()
    config, invocation = pickle.load(sys.stdin.buffer)
    job: Job = invocation.job

    def leave(*_: object) -> None:
        """Ends the job at once: raised inside compiled code, an interrupt can come out as any other error."""
        job.write_outcome(failure=INTERRUPTED)
        os._exit(130)

    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, leave)
    try:
        figures = run_experiment(config, invocation)
    except Exception as error:
        line = mistake_in_one_line(error)
        if line is None:
            traceback.print_exc()
        remove_if_empty(invocation.folder)
        print(f"[{job.label}] failed: {line or repr(error)}", file=sys.stderr, flush=True)
        job.write_outcome(failure=line or repr(error))
    else:
        job.write_outcome(figures=figures)


def leave_with_parent(parent_pid: int) -> None:
    """Ends this process when the one that started it is gone, rather than going on for nobody."""
    while os.getppid() == parent_pid:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)


def remove_if_empty(folder: Path) -> None:
    """Removes what Hydra wrote into the folder of a run that has not come as far as a checkpoint."""
    if not (folder / LAST_CHECKPOINT).exists():
        remove_run_folder(folder)


def raise_or_exit(error: Exception) -> NoReturn:
    """Answers a user's mistake in one line and leaves; raises any other error, or all where tracebacks are wanted."""
    line = mistake_in_one_line(error)
    if line is None or os.environ.get(WANTS_TRACEBACKS):
        raise error
    print(f"error: {line}", file=sys.stderr)
    raise SystemExit(2)


def main() -> int:
    """Runs what the command line asks for; returns the exit code."""
    if os.environ.get("HYDRA_FULL_ERROR") == "1":
        os.environ[WANTS_TRACEBACKS] = "1"
    # Hydra raises, so that its errors are answered here and not by Hydra.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Whoever ends a run, by Ctrl-C or by kill, finds it closed as killed in the tracking store.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    quieten_libraries()
    # Hydra reads its options only before the first override, and people write them anywhere.
    sys.argv[1:] = sorted(sys.argv[1:], key=lambda word: word not in ("-m", "--multirun"))
    try:
        hydra.main(version_base="1.3", config_path="pkg://armscan.conf", config_name="config")(run)()
    except KeyboardInterrupt:
        end_multirun(is_interrupted=True)
        print(INTERRUPTED, file=sys.stderr)
        return 130
    except Exception as error:
        end_multirun()
        raise_or_exit(error)
    return end_multirun()


if __name__ == "__main__":
    # The module under its own name: jobs in other processes find their function there.
    from armscan.run import main as run_main

    sys.exit(run_main())
