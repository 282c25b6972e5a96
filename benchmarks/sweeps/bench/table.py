"""The table of a bench: for each configuration and seed the validation of each epoch, and evaluations at the end."""

from __future__ import annotations

import gzip
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from armscan.errors import InvalidValueError
from armscan.sweeps.space.space import Space
from armscan.utils.arrays import FloatArray
from armscan.utils.files import atomic_write
from benchmarks.sweeps.bench.design import Design, places_of

FOLDER = Path(__file__).parent / "tables"
# Fewer trainings of a configuration say too little about the noise between seeds.
MIN_SEEDS = 3
VALIDATION, SELECTION, TEST = "validation", "selection", "test"
# What the bench compares, and the headline figure of a run.
METRICS = ("mean_steps", "on_plane_5mm_10deg")
# Columns of each row, beside the values of its configuration and the metrics.
ROW = ("fixed_sha256", "commit", "config", "seed", "volumes", "env_steps", "processor_s")


def table_file(sweep: str) -> Path:
    """Return where the table of a sweep is."""
    return FOLDER / f"{sweep}.csv.gz"


def read_rows(file: Path) -> pd.DataFrame:
    """Return the rows of a table; none where it does not exist yet."""
    if not file.exists():
        return pd.DataFrame(columns=[*ROW, *METRICS])
    return pd.read_csv(file, dtype={"fixed_sha256": str, "commit": str})


def write_rows(file: Path, rows: pd.DataFrame) -> None:
    """Write the rows of a table, in the order of their configurations and seeds."""
    write_sorted(file, rows, ["config", "seed", "volumes", "env_steps"], [True, True, False, True])


def write_sorted(file: Path, rows: pd.DataFrame, by: list[str], ascending: bool | list[bool] = True) -> None:
    """Write rows in the order of some columns; a reader never sees half of them."""
    text = rows.sort_values(by, ascending=ascending).to_csv(index=False, float_format="%.7g")
    # The same rows give the same file.
    atomic_write(file, gzip.compress(text.encode(), mtime=0))


def check_rows(rows: pd.DataFrame, design: Design) -> None:
    """Raise `InvalidValueError` if rows have other values than the configurations of a design."""
    for number, of_config in rows.groupby("config"):
        for name, value in design.configs[number].items() if number < len(design.configs) else ():
            if name not in rows or (of_config[name] != value).any():
                raise InvalidValueError(f"the table of {design.sweep} has another {name} in configuration {number}")


@dataclass(frozen=True)
class Curves:
    """The curves of the configurations that have been trained with enough seeds.

    Args:
        sweep: Name of the sweep.
        space: Search space of the sweep.
        configs: Values by name of each configuration; the first is the default one.
        config_of: Index of each training's configuration in `configs`, shape (trainings,).
        env_steps: Environment steps at the end of each epoch, shape (epochs,).
        validation: Metrics of each epoch by name, shape (trainings, epochs).
        selection: Metrics of the best epoch's weights by name, on the validation volumes in episodes that did not
            select weights, shape (trainings,).
        test: The same on the test volumes, shape (trainings,).
        processor_s: Processor seconds of each training, shape (trainings,).
    """

    sweep: str
    space: Space
    configs: tuple[dict[str, Any], ...]
    config_of: NDArray[np.intp]
    env_steps: FloatArray
    validation: dict[str, FloatArray]
    selection: dict[str, FloatArray]
    test: dict[str, FloatArray]
    processor_s: FloatArray

    @classmethod
    def read(cls, sweep: str, file: Path | None = None) -> Curves:
        """Return the curves of a table, without the configurations that have few seeds yet.

        Args:
            sweep: Name of the sweep.
            file: File of the table. Default: None, the one that `collect` writes.
        """
        rows = read_rows(file or table_file(sweep))
        collecting = f"python -m benchmarks.sweeps.bench collect {sweep}"
        if rows.empty:
            raise InvalidValueError(f"there is no table of {sweep} yet: {collecting}")
        design = Design.of(sweep, int(rows.config.max()) + 1)
        check_rows(rows, design)
        n_seeds = rows[rows.volumes == SELECTION].groupby("config").seed.nunique()
        numbers = n_seeds[n_seeds >= MIN_SEEDS].index
        if numbers.empty:
            raise InvalidValueError(f"no configuration in the table of {sweep} has {MIN_SEEDS} seeds yet: {collecting}")
        rows = rows[rows.config.isin(numbers)].sort_values(["config", "seed", "env_steps"])
        epochs, selections, tests = (rows[rows.volumes == volumes] for volumes in (VALIDATION, SELECTION, TEST))
        env_steps = epochs.env_steps.to_numpy(float).reshape(len(tests), -1)
        if (env_steps != env_steps[0]).any():
            raise InvalidValueError(f"the epochs of the table of {sweep} are not all after the same environment steps")
        return cls(
            sweep,
            design.space,
            tuple(design.configs[number] for number in numbers),
            np.searchsorted(numbers, tests.config),
            env_steps[0],
            {name: epochs[name].to_numpy(float).reshape(env_steps.shape) for name in METRICS},
            {name: selections[name].to_numpy(float) for name in METRICS},
            {name: tests[name].to_numpy(float) for name in METRICS},
            tests.processor_s.to_numpy(float),
        )

    def of(self, numbers: NDArray[np.intp]) -> Curves:
        """Return the curves of some configurations, given by index; one that is given twice counts twice."""
        trainings = [np.flatnonzero(self.config_of == number) for number in numbers]
        drawn = np.concatenate(trainings)
        return replace(
            self,
            configs=tuple(self.configs[number] for number in numbers),
            config_of=np.repeat(np.arange(len(numbers)), [len(each) for each in trainings]),
            validation={name: values[drawn] for name, values in self.validation.items()},
            selection={name: values[drawn] for name, values in self.selection.items()},
            test={name: values[drawn] for name, values in self.test.items()},
            processor_s=self.processor_s[drawn],
        )

    def places(self) -> FloatArray:
        """Return where each configuration lies in the space, shape (configurations, dimensions), from 0 to 1."""
        return np.array([places_of(self.space, values) for values in self.configs])

    def mean_over_seeds(self, values: FloatArray) -> FloatArray:
        """Return the mean of each configuration's trainings, shape (configurations, ...) of (trainings, ...)."""
        return np.array([values[self.config_of == number].mean(axis=0) for number in range(len(self.configs))])
