"""Train the configurations of a bench, each with every seed, and keep their curves."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import pandas as pd

from armscan.errors import InvalidValueError
from benchmarks.sweeps.bench.design import Design
from benchmarks.sweeps.bench.table import (
    METRICS,
    SELECTION,
    TEST,
    VALIDATION,
    check_rows,
    read_rows,
    table_file,
    write_rows,
)


def collect(
    sweep: str,
    n_configs: int,
    n_seeds: int,
    workers: int = 1,
    *,
    allow_changes: bool = False,
    overrides: Sequence[str] = (),
    file: Path | None = None,
) -> None:
    """Train what is missing in the table of a sweep: all seeds of a configuration before the next one.

    Args:
        sweep: Name of the sweep, such as `sac_y`.
        n_configs: Number of configurations, the default one included.
        n_seeds: Trainings of each, with the seeds from 0.
        workers: Processes that train. Default: 1, this one.
        allow_changes: Whether to extend a table although settings that are not searched have changed since. Default:
            False.
        overrides: Overrides of all trainings, as on the command line. Default: none.
        file: File of the table. Default: None, the one of the bench.
    """
    file = file or table_file(sweep)
    design, rows = Design.of(sweep, n_configs, overrides), read_rows(file)
    check_rows(rows, design)
    # Tables of earlier versions have trainings without a selection, which are trained again.
    rows = rows.groupby(["config", "seed"]).filter(lambda training: (training.volumes == SELECTION).any())
    earlier = set(rows.fixed_sha256) - {design.fixed_sha256}
    if earlier and not allow_changes:
        raise InvalidValueError(
            f"settings of {sweep} that are not searched have changed since {file.name} was begun: give --allow-changes "
            "if they change no training, or take the table away"
        )
    done = set(zip(rows.config, rows.seed, strict=True))
    missing = [(number, seed) for number in range(n_configs) for seed in range(n_seeds) if (number, seed) not in done]
    print(f"{sweep}: {len(done)} trainings are in {file.name}, {len(missing)} are missing", flush=True)
    origin = {"fixed_sha256": design.fixed_sha256, "commit": commit()}
    run_jobs(
        [
            joblib.delayed(trained_rows)(
                [f"sweep={sweep}", *overrides], {**origin, "config": number, "seed": seed}, design.configs[number]
            )
            for number, seed in missing
        ],
        rows,
        partial(write_rows, file),
        workers,
    )


def run_jobs(jobs: Sequence[Any], rows: pd.DataFrame, write: Callable[[pd.DataFrame], None], workers: int) -> None:
    """Run trainings, and write a table after each of them.

    Args:
        jobs: Calls that return the rows of a training, delayed by joblib.
        rows: Rows that the table has already.
        write: Function that writes all rows.
        workers: Processes that train.
    """
    start_s = time.monotonic()
    trained = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")(jobs)
    for n_trained, of_training in enumerate(trained, start=1):
        fresh = pd.DataFrame(of_training)
        rows = pd.concat([rows, fresh], ignore_index=True) if len(rows) else fresh
        write(rows)
        each_s = (time.monotonic() - start_s) / n_trained
        print(f"{n_trained} of {len(jobs)} trainings, {each_s:.1f} s each", flush=True)


def trained_rows(words: Sequence[str], training: Mapping[str, Any], values: dict[str, Any]) -> list[dict[str, Any]]:
    """Train a configuration with a seed to its end as a trial would, and return its rows of the table.

    Args:
        words: Overrides of the configuration, as on the command line.
        training: Columns that every row has, such as the seed.
        values: Values of the configuration by name.
    """
    recorder = _Recorder()
    result, evaluations = train_and_evaluate([*words], values, int(training["seed"]), [recorder])
    last = {"env_steps": result.best.n_env_steps, "processor_s": recorder.epochs[-1]["processor_s"]}
    ends = [{"volumes": name, **last, **_shortened(each.metrics())} for name, each in evaluations.items()]
    return [{**training, **row, **values} for row in (*recorder.epochs, *ends)]


def train_and_evaluate(
    words: Sequence[str], values: Mapping[str, Any], seed: int, callbacks: Sequence[Any] = ()
) -> tuple[Any, dict[str, Any]]:
    """Train a configuration with a seed to its end as a trial would, and evaluate its best epoch.

    Args:
        words: Overrides of the configuration, as on the command line.
        values: Values of the configuration by name.
        seed: Seed of the training.
        callbacks: Callbacks of the training. Default: none.

    Returns:
        The result of the training, and two evaluations: `selection`, on the validation volumes as in the race of a
        study, and `test`, on the test volumes.
    """
    from armscan.config.compose import compose_run
    from armscan.experiment.build import build_setup
    from armscan.experiment.runner import train_agent
    from armscan.sweeps.space.parameter import overrides_of
    from armscan.sweeps.tasks.attempt import volumes_of
    from armscan.training import evaluate
    from armscan.training.episode_seeds import SELECTION_SEED, TEST_VOLUMES_SEED
    from armscan.utils.log import silence_libraries

    silence_libraries()
    config, _ = compose_run([*words, *overrides_of(values), f"seed={seed}"])
    setup = build_setup(config, volumes_of(config))
    with tempfile.TemporaryDirectory() as folder:
        result = train_agent(setup, Path(folder), callbacks, run_id="bench", tell=lambda _: None)
    where = {SELECTION: (setup.validation_env, SELECTION_SEED), TEST: (setup.test_env, TEST_VOLUMES_SEED)}
    return result, {
        name: evaluate(setup.agent, env, n_episodes=setup.n_episodes, seed=first + setup.seed, on_plane=setup.on_plane)
        for name, (env, first) in where.items()
    }


@dataclass
class _Recorder:
    """A training callback that keeps the validation of each epoch."""

    epochs: list[dict[str, Any]] = field(default_factory=list)
    start_s: float = 0.0

    def on_start(self, total_env_steps: int, earlier: Any) -> None:
        self.start_s = time.process_time()

    def on_epoch(self, report: Any) -> None:
        self.epochs.append(
            {
                "volumes": VALIDATION,
                "env_steps": report.n_env_steps,
                "processor_s": round(time.process_time() - self.start_s, 2),
                **_shortened(report.evaluation.metrics()),
            }
        )

    def on_end(self) -> None:
        pass


def _shortened(metrics: dict[str, float]) -> dict[str, float]:
    # The episodes justify no more than four digits.
    return {name: float(f"{metrics[name]:.4g}") for name in METRICS}


def commit() -> str:
    """Return the commit of the code, with `-dirty` if it has changed since."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=9"]
    return subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True).stdout.strip()
