"""Configurations of earlier versions: keys and classes that have been renamed.

Files of runs and attributes of studies keep the names that they were written with; `migrate` renames them on reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# A configuration of an earlier version has this `env._target_`.
OLD_ENV = "armscan.envs.EnvMaker"
RENAMED_KEYS = {
    "agent.astray_share": "agent.perturbed_share",
    "agent.entropy_coefficient": "agent.ent_coef",
    "agent.entropy_lr": "agent.ent_coef_lr",
    "agent.final_lr_share": "agent.lr_end_factor",
    "agent.initial_entropy_coefficient": "agent.ent_coef_init",
    "agent.initial_log_sigma": "agent.log_std_init",
    "agent.judged_by_sampling": "agent.deterministic_eval",
    "agent.normalise_advantage": "agent.normalize_advantage",
    "agent.passes_per_collection": "agent.n_epochs",
    "agent.random_env_steps": "agent.learning_starts",
    "agent.startup_planes": "agent.n_startup_trials",
    "agent.updates_per_env_step": "agent.utd_ratio",
    "agent.value_coefficient": "agent.vf_coef",
    "env.delta": "env.success_threshold",
    "training.epoch_env_steps": "training.eval_every_env_steps",
}
# In the section `study`, which runs do not store.
RENAMED_KEYS_OF_STUDIES = {
    f"study.final_eval.{before}_seeds": "study.final_eval.test_seeds" for before in ("n", "judge")
}
INVERTED = ("agent.judged_by_sampling",)
# Truth values of a configuration, and of MLflow's parameters.
OPPOSITES = {True: False, False: True, "True": "False", "False": "True"}
RENAMED_TARGETS = {
    OLD_ENV: "armscan.envs.EnvFactory",
    "armscan.multirun.Multirun": "armscan.launch.multirun.Multirun",
    "armscan.sweeps.landmarks.Landmarks": "armscan.sweeps.tasks.landmarks.LandmarksTask",
    "armscan.sweeps.training.Training": "armscan.sweeps.tasks.training.TrainingTask",
}


def migrate(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored configuration with the keys and classes of this version.

    Args:
        config: Resolved configuration, nested or as leaves by their dotted keys. A configuration of this version is
            returned unchanged.
    """
    env, agent = config.get("env"), config.get("agent")
    target = env.get("_target_") if isinstance(env, Mapping) else config.get("env._target_")
    # Written between the two renamings: the new environment, but the old key.
    is_between = "astray_share" in agent if isinstance(agent, Mapping) else "agent.astray_share" in config
    return renamed(config) if target == OLD_ENV or is_between else dict(config)


def rename_hint(key: str) -> str | None:
    """Return the current name of a key of an earlier version; None if the key has not been renamed."""
    if (now := (RENAMED_KEYS | RENAMED_KEYS_OF_STUDIES).get(key)) is None:
        return None
    return f"{key} has been renamed: give {now}" + (", which means the opposite" if key in INVERTED else "")


def renamed(config: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return all or some values of an earlier version's configuration under their names of this version.

    Args:
        config: Configuration, nested or as leaves by their dotted keys.
        path: Dotted path of the section, ending with a dot; empty for the whole configuration.
    """
    result = {}
    for name, value in config.items():
        key = f"{path}{name}"
        if isinstance(value, Mapping):
            value = renamed(value, f"{key}.")
        elif isinstance(value, list):
            # Such as the segments of a schedule, which have dotted keys.
            value = [renamed(each) if isinstance(each, Mapping) else each for each in value]
        elif key in INVERTED:
            value = OPPOSITES.get(value, value)
        elif isinstance(value, str):
            value = RENAMED_TARGETS.get(value, value)
        result[RENAMED_KEYS.get(key, key).removeprefix(path)] = value
    return result
