"""Names of the tags of runs in MLflow."""

# MLflow's own: the run that a run is shown below, and the description of a run.
PARENT_TAG, NOTE_TAG = "mlflow.parentRunId", "mlflow.note.content"
# Absolute path of the folder of a run, and the name of the machine that has it.
FOLDER_TAG, HOST_TAG = "folder", "host"
# Version of armscan that made a run.
VERSION_TAG = "armscan.version"
# Beginning of the tags with a run's choice of each group. Only trainings have them, not the runs above these.
CHOICE = "choice."
AGENT_TAG, OBS_TAG = f"{CHOICE}agent", f"{CHOICE}obs"
# What the agent of a run was trained on, as `armscan.training.TrainingDomain` writes it.
DOMAIN_TAG = "trained_on"
# Run that an evaluation is of; only evaluations have it.
EVALUATED_TAG = "evaluation.of"
# Why a run ended before its end.
FAILURE_TAG = "failure"
# Of the run of a job: its number. Of the run of a grid: the words that repeat it.
JOB_TAG, GRID_TAG = "job", "grid"
# Of the runs of a study: its name and storage, the number of the trial, and whether that was pruned.
STUDY_TAG, STORAGE_TAG, TRIAL_TAG, PRUNED_TAG = "study", "study.storage", "trial", "pruned"
