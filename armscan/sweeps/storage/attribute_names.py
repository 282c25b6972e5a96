"""Names of the user attributes of studies and trials, as storages have them."""

# Of a study: its space, its configuration without what it searches, and the directions of its objectives.
SPACE, FIXED, OBJECTIVES = "space", "fixed_config", "objectives"
# What each study of armscan has.
OF_STUDY = {SPACE, FIXED, OBJECTIVES}
# Its tracked run, the SHA-256 of the note that was left at it, and what it has begun with.
STUDY_RUN, NOTE_SUM, BEGUN_WITH = "mlflow_run", "note_sha256", "begun_with"
# Why it has ended, and what was asked of it then; trials whose failures are ignored.
TERMINATED, RESET_FAILURES = "terminated", "forgiven"
# Of a trial, or of a study: who asked it to stop, and when; an empty text where a study goes on again.
STOP = "stop"

# Of a trial.
LEASE, ENV_STEPS, METRICS, FAILURE = "lease", "env_steps", "figures", "failure"
RETRIED, RETRY_OF, ATTEMPT, SEEDS = "retried", "retry_of", "attempt", "seeds"
RUN, FOLDER, CONFIG_SHA256 = "mlflow_run", "folder", "config_sha256"
# Of a trial that a study has begun with: where it was run, or what its settings are of.
TAKEN_FROM, ENQUEUED_FROM = "taken_from", "enqueued_from"
# Of a final training: the trial whose configuration is trained, and the seed.
FINALIST, FINAL_SEED = "judged", "judged_seed"
# Of a member of a population: its number, its generation, the environment steps at which that begins and ends, the
# trial whose checkpoint it begins from, and all values since the first generation, as `training.schedule` has them.
MEMBER, GENERATION, INTERVAL, PARENT, SCHEDULE = "member", "generation", "interval", "parent", "schedule"
# What a retry has from the attempt before.
KEPT_BY_RETRY = (SEEDS, FINALIST, FINAL_SEED, STOP, ENQUEUED_FROM, MEMBER, GENERATION, INTERVAL, PARENT, SCHEDULE)

# In a lease: the worker that holds the trial.
HOLDER = ("worker", "host", "pid", "started", "boot", "pid_namespace")
# A system attribute of a trial: the episodes of the final evaluation.
EPISODES = "episodes"
