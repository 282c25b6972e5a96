"""Training callback that reports to the trial's study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from armscan.sweeps.storage.attribute_names import ENV_STEPS
from armscan.sweeps.tasks.attempt import Attempt
from armscan.sweeps.tasks.generation import inherited
from armscan.training import Budget, EpochReport, Evaluation, TrainingResult

# Metrics of each training, in addition to those on the validation volumes.
TRAINING_METRICS = (ENV_STEPS, "training_s", "solved")


@dataclass
class Reporter:
    """A training callback that reports to the study, with the reports of an earlier attempt.

    Args:
        attempt: The attempt at the trial.
        seed: Seed of the training.
        budget: Budget of the training.
        reports: Reports of its epochs so far. Default: none.
    """

    attempt: Attempt
    seed: int
    budget: Budget
    reports: list[EpochReport] = field(default_factory=list)

    def on_start(self, total_env_steps: int, earlier: Sequence[EpochReport]) -> None:
        """Report the epochs of an earlier attempt."""
        for report in earlier:
            self.on_epoch(report)

    def on_epoch(self, report: EpochReport) -> None:
        """Report the validation of an epoch, unless the trial has inherited the epoch from its parent."""
        self.reports.append(report)
        before = inherited(self.attempt, self.reports)
        # The reports come one by one, so the last inherited epoch may not be among them yet.
        is_inherited = self.attempt.parent_folder is not None if before is None else report.epoch <= before.epoch
        if is_inherited:
            return
        grid = self.budget.eval_every_env_steps
        # Rounded down to the grid: how far vectorised environments step beyond it says nothing about a trial.
        so_far = dict(zip(TRAINING_METRICS, (report.n_env_steps // grid * grid, report.wall_s, 0.0), strict=True))
        self.attempt.report(
            self._validation().metrics() | so_far,
            seed=self.seed,
            n_env_steps=report.n_env_steps,
            report_every_env_steps=grid,
            total_env_steps=self.budget.env_steps,
            n_inherited_env_steps=before.n_env_steps if before is not None else 0,
        )

    def on_end(self) -> None:
        """Report nothing: `metrics` returns the result of the training."""

    def metrics(self, result: TrainingResult) -> dict[str, float]:
        """Return `TRAINING_METRICS` of a finished training, without what it has inherited from another trial."""
        before = inherited(self.attempt, result.reports)
        n_before, before_s = (before.n_env_steps, before.wall_s) if before is not None else (0, 0.0)
        measured = (result.reports[-1].n_env_steps - n_before, result.wall_s - before_s, float(result.is_solved))
        return dict(zip(TRAINING_METRICS, measured, strict=True))

    def _validation(self) -> Evaluation:
        """Return the last validation; with several objectives the best one, whose weights the training would end with.

        Pruners of one objective take the best report themselves.
        """
        several = len(self.attempt.objectives) > 1
        return [report for report in self.reports if report.is_best or not several][-1].evaluation
