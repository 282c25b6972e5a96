"""First seeds of the episodes for each purpose.

The run's seed is added to each. First seeds are a million apart, so no episode serves two purposes as long as the sum
of the run's seed and the number of episodes is below a million.
"""

from __future__ import annotations

VALIDATION_SEED, TRAINING_VOLUMES_SEED, TEST_VOLUMES_SEED, VIDEO_SEED = 1_000_000, 2_000_000, 3_000_000, 4_000_000
# Of `armscan evaluate`, of the check of an exported policy, and of the selection of a study.
EVALUATION_SEED, EXPORT_SEED, SELECTION_SEED = 5_000_000, 6_000_000, 7_000_000
