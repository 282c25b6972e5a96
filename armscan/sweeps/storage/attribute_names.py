"""Names of the attributes of studies and trials in a storage."""

# Of a study: its space, its configuration without the searched values, and the directions of its objectives.
SPACE, FIXED, OBJECTIVES = "space", "fixed_config", "objectives"
# Every study of armscan has these.
OF_STUDY = {SPACE, FIXED, OBJECTIVES}
# The configurations of earlier trials, each by the number of the first trial after it.
EARLIER_CONFIGS = "earlier_configs"
# The machine and folder that it was begun in, with a random ID, which that folder has too.
BEGUN_IN = "begun_in"
# Its tracked run, the SHA-256 of armscan's own note in the dashboard, and the origins of its initial trials.
STUDY_RUN, NOTE_SUM, BEGUN_WITH = "mlflow_run", "note_sha256", "begun_with"
# Why it has ended, and the settings asked for at that time, or, once it is reopened, the number of trials finished by
# then; trials whose failures are ignored.
TERMINATED, RESET_FAILURES = "terminated", "forgiven"
# Of a trial or a study: when it was asked to stop, and by whom; empty once a study is resumed.
STOP = "stop"

# Of a trial.
LEASE, ENV_STEPS, METRICS, FAILURE = "lease", "env_steps", "figures", "failure"
RETRIED, RETRY_OF, ATTEMPT, SEEDS = "retried", "retry_of", "attempt", "seeds"
# The step of the report at which the pruner pruned it, known before its worker tells.
PRUNED_AT = "pruned_at"
# Of a waiting final training that another configuration of the study does not want: it counts nowhere.
DROPPED = "dropped"
# When it ran before it was requeued: pairs of start and end, in seconds since 1970.
EARLIER_SPANS = "earlier_spans"
RUN, FOLDER, CONFIG_SHA256 = "mlflow_run", "folder", "config_sha256"
# Of an initial trial: the study and number of the trial it was taken from, or the origin of its settings.
TAKEN_FROM, ENQUEUED_FROM = "taken_from", "enqueued_from"
# Of a final training: the trial whose configuration is trained, the seed, and the SHA-256 of the study's configuration.
FINALIST, FINAL_SEED, OF_CONFIG = "judged", "judged_seed", "study_config_sha256"
# Of a member of a population: its number, its generation, the environment steps at which that begins and ends, the
# trial whose checkpoint it begins from, and all values since the first generation, in the form of `training.schedule`.
MEMBER, GENERATION, INTERVAL, PARENT, SCHEDULE = "member", "generation", "interval", "parent", "schedule"
# What a retry takes over from the attempt before.
KEPT_BY_RETRY = (
    *(SEEDS, FINALIST, FINAL_SEED, OF_CONFIG, STOP, PRUNED_AT, ENQUEUED_FROM),
    *(MEMBER, GENERATION, INTERVAL, PARENT, SCHEDULE),
)

# In a lease: the version of armscan's code, see `code_version`; the worker that holds the trial.
CODE = "code"
HOLDER = ("worker", "host", "pid", "started", "boot", "pid_namespace", CODE)
# System attributes of a trial: the episodes of the final evaluation; without episodes, the subject of each test volume.
EPISODES, SUBJECTS = "episodes", "subjects"
