"""Names of the tags of runs in MLflow."""

# MLflow's own tags: the parent of a run, its description, and the commit of its code.
PARENT_TAG, DESCRIPTION_TAG = "mlflow.parentRunId", "mlflow.note.content"
COMMIT_TAG = "mlflow.source.git.commit"
# Value of a tag that could not be found out.
UNKNOWN = "unknown"
# Absolute path of a run's folder, the name of its machine, and the folder in which it was started.
FOLDER_TAG, HOST_TAG, WORKING_FOLDER_TAG = "folder", "host", "working_folder"
# Command that started a run, and how often it was resumed.
COMMAND_TAG, RESUMED_TAG = "command", "resumed"
# Overrides of a run, as on its command line; of a study those of the latest command.
OVERRIDES_TAG = "overrides"
# Version of armscan that made a run.
VERSION_TAG = "armscan.version"
# Prefix of the tags with a run's choice of each configuration group. Only trainings have them, not their parent runs.
CHOICE = "choice."
AGENT_TAG, OBS_TAG = f"{CHOICE}agent", f"{CHOICE}obs"
# Prefixes of the tags with the volumes of a split, each with the beginning of its fingerprint, and their subjects.
VOLUMES, SUBJECTS = "volumes.", "subjects."
# What the agent of a run was trained on, as `armscan.training.TrainingDomain` writes it.
DOMAIN_TAG = "trained_on"
# Checksums of the modules of the user's own classes, by their names.
OWN_CODE_TAG = "own_code"
# The run that was evaluated; only evaluations have this tag.
EVALUATED_TAG = "evaluation.of"
# Why a run failed or was interrupted.
FAILURE_TAG = "failure"
# Of a job's run: its number. Of a grid's run: the arguments that repeat it.
JOB_TAG, GRID_TAG = "job", "grid"
# Of a grid's run: the run of its best job, whose figures it shows.
BEST_TAG = "best.run"
# Of a grid's run: the run of the later grid that has taken over its jobs.
CONTINUED_TAG = "continued_by"
# Of a study's runs: its name and storage, the number of the trial, and whether the trial was pruned.
STUDY_TAG, STORAGE_TAG, TRIAL_TAG, PRUNED_TAG = "study", "study.storage", "trial", "pruned"
# Prefixes of metrics: of validations, of what a study measures to select a configuration, and of the test volumes.
VALIDATION_PREFIX, SELECTION_PREFIX, TEST_VOLUMES_PREFIX = "validation/", "selection/", "test_volumes/"
# Metric of a training: the environment steps after which its best weights were kept.
BEST_ENV_STEP = "best_env_step"
