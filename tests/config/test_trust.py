"""Code that a stored configuration may execute."""

import copy
import functools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.config.defaults import to_plain
from armscan.config.trust import (
    check_stored_address,
    check_stored_words,
    offered_classes,
    stored_config,
    untrusted_word,
)
from armscan.errors import UntrustedError

STORE = "http://127.0.0.1:5000"
FOREIGN = (
    "os.system",
    "torch.load",
    "armscan.agents.SAC.__init__",
    "armscan.run.launch",
    " armscan.agents.SAC",
    "",
    None,
    1,
    ["a"],
)


@functools.cache
def default_config():
    return to_plain(compose([]))


@given(data=st.data(), target=st.sampled_from(FOREIGN))
def test_class_of_others_is_refused_at_every_place(data, target):
    config = copy.deepcopy(default_config())
    # Any place of the configuration, in a list or a mapping of its own.
    node, path = config, []
    while isinstance(node, dict) and data.draw(st.booleans(), label="deeper"):
        key = data.draw(st.sampled_from(sorted(node)), label="key")
        if not isinstance(node[key], dict):
            break
        node, path = node[key], [*path, key]
    described = {"_target_": target, "command": "true"}
    node["added"] = data.draw(st.sampled_from([described, [described], {"a": [[described]]}]), label="added")
    with pytest.raises(UntrustedError, match="repeat the command with --trust"):
        stored_config(config, where="run 1", trust=False)
    assert stored_config(config, where="run 1", trust=True) == config


def test_interpolation_is_refused(monkeypatch):
    monkeypatch.setenv("SECRET", "secret")
    config = to_plain(compose([])) | {"seed": "${oc.env:SECRET}"}
    assert OmegaConf.create(config).seed == "secret"
    with pytest.raises(UntrustedError, match=r"seed='\$\{oc.env:SECRET\}'"):
        stored_config(config, where="run 1", trust=False)


def test_offered_classes_are_of_runs_and_not_of_commands():
    assert {"armscan.agents.SAC", "armscan.envs.EnvFactory", "armscan.training.phantom_data"} <= offered_classes()
    assert {name.partition(".")[0] for name in offered_classes()} == {"armscan"}
    assert not {name for name in offered_classes() if name.startswith("armscan.launch")}


@pytest.mark.parametrize(
    "word",
    [
        "agent._target_=os.system",
        "+x={_target_: os.system}",
        "seed=${oc.env:SECRET}",
        r"seed=$\{oc.env:SECRET\}",
        "hydra/launcher=submitit_slurm",
        "+hydra.searchpath=[/tmp]",
        "~hydra.callbacks",
        "+obs@hydra.launcher=cluster",
        "--config-dir=/tmp",
        "tracking.uri=http://elsewhere",
        f"tracking.uri={STORE}.elsewhere",
        "tracking.artifacts='s3://elsewhere'",
        r"tracking.uri=http\://elsewhere",
        "tracking.uri=sqlite:///mlruns.db,http://elsewhere",
        "+cluster.tracking_uri=http://elsewhere",
        "+cluster={tracking_uri: http://elsewhere}",
    ],
)
def test_stored_command_line_that_could_execute_code_is_refused(word):
    with pytest.raises(UntrustedError, match="run 1: its command line has"):
        check_stored_words(["seed=1,2", word], STORE, where="run 1")


def test_stored_command_line_of_a_usual_grid_is_accepted():
    words = [
        "obs=cluster,slice",
        "agent.lr=0.1,0.2",
        f"tracking.uri={STORE}",
        "tracking.experiment=mine",
        "data.path=/x",
    ]
    assert untrusted_word(words, STORE) is None
    for uri in ("sqlite:///mlruns.db", "'sqlite:///mlruns.db'", f"'{STORE}'"):
        assert untrusted_word([f"tracking.uri={uri}"], STORE) is None


@pytest.mark.parametrize("secret", ["MLFLOW_TRACKING_PASSWORD", "MLFLOW_TRACKING_TOKEN"])
def test_password_is_sent_to_no_address_that_a_folder_names(monkeypatch, secret):
    check_stored_address("http://elsewhere:5000")
    monkeypatch.setenv(secret, "secret")
    with pytest.raises(UntrustedError, match=f"http://elsewhere:5000 would be sent this user's {secret}"):
        check_stored_address("http://elsewhere:5000")
    check_stored_address("sqlite:////mlruns.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://elsewhere:5000")
    check_stored_address("http://elsewhere:5000")
