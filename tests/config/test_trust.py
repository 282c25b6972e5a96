"""Code that a stored configuration may execute."""

import copy
import functools
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from armscan.config.compose import compose
from armscan.config.defaults import to_plain
from armscan.config.trust import (
    check_artifact_address,
    check_composed,
    check_stored_address,
    check_stored_overrides,
    offered_classes,
    stored_config,
    untrusted_override,
)
from armscan.errors import UntrustedError, printable

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


@pytest.mark.parametrize(
    "changes",
    [
        {"data.n_test": {"_target_": "armscan.training.phantom_data", "cache_dir": "/tmp"}},
        {"agent.lr": {"_target_": "armscan.training.phantom_data", "n_training": 1}},
        {"env.observation.0.cache_dir": "/tmp"},
        {"data._args_": [1, 1, 1, 0, "/tmp"]},
        {"env._args_": []},
        {"data._partial_": True},
    ],
)
def test_stored_configuration_writes_phantoms_into_no_folder(changes):
    config = OmegaConf.create(default_config())
    for key, value in changes.items():
        OmegaConf.update(config, key, value, force_add=True)
    with pytest.raises(UntrustedError, match=r"run 1: its configuration has .*_(args|partial)_|only in the section"):
        stored_config(to_plain(config), where="run 1", trust=False)
    assert stored_config(default_config(), where="run 1", trust=False)["data"]["cache_dir"] is None


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
        # Hydra would compose these files, wherever they lie.
        "experiment=../../elsewhere",
        "experiment=best_y,../elsewhere",
        "experiment=[best_y,../elsewhere]",
        "experiment='../elsewhere'",
        "++experiment=str(../elsewhere)",
        "experiment=glob(../*)",
        "experiment=mine/../../elsewhere",
        r"experiment=.\./elsewhere",
        "+obs@env.other=../elsewhere",
        "+study/sampler=../elsewhere",
        "sweep=/elsewhere",
        'sweep="/elsewhere"',
        "sweep=sac_y, /elsewhere",
        "sweep=sac_y",
        "+sweep@_global_=sac_y",
    ],
)
def test_stored_command_line_that_could_execute_code_is_refused(word):
    with pytest.raises(UntrustedError, match="run 1: its command line has"):
        check_stored_overrides(["seed=1,2", word], STORE, where="run 1")


def test_stored_command_line_of_a_usual_grid_is_accepted():
    words = [
        "obs=cluster,slice",
        "agent.lr=0.1,0.2",
        f"tracking.uri={STORE}",
        "tracking.experiment=mine",
        "data.path=/x,../y",
        "experiment=best_y,mine/best",
    ]
    assert untrusted_override(words, STORE) is None
    for uri in ("sqlite:///mlruns.db", "'sqlite:///mlruns.db'", f"'{STORE}'"):
        assert untrusted_override([f"tracking.uri={uri}"], STORE) is None


def test_composed_configuration_builds_what_a_file_here_names_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "conf/agent").mkdir(parents=True)
    (tmp_path / "conf/agent/mine.yaml").write_text("_target_: 'mine.Agent'")
    monkeypatch.chdir(tmp_path)
    config = default_config()
    check_composed(config | {"agent": {"_target_": "mine.Agent"}}, where="job 1")
    with pytest.raises(UntrustedError, match=r"job 1: its configuration builds agent by 'joblib.load'"):
        check_composed(config | {"agent": {"_target_": "joblib.load"}}, where="job 1")


@pytest.mark.parametrize(
    "uri", ["http://elsewhere:5000", "postgresql://me@elsewhere/db", "mysql://elsewhere/db", "sqlite:////theirs.db"]
)
def test_password_is_sent_to_no_server_that_a_folder_names(uri):
    with pytest.raises(UntrustedError, match=f"could be sent this user's passwords, .* give --tracking {uri}"):
        check_stored_address(uri, {STORE})
    check_stored_address(uri, {STORE, uri})


@pytest.mark.parametrize("store", [STORE, "sqlite:////mlruns.db"])
@pytest.mark.parametrize(
    "uri",
    [
        *(
            "http://elsewhere:5000/a",
            "mlflow-artifacts://elsewhere/a",
            "runs:/0/a",
            "abfss://a@elsewhere/a",
            "http://[a",
        ),
        # requests sends these to `elsewhere`, or nowhere; urllib names 127.0.0.1.
        *(r"http://elsewhere:9\@127.0.0.1:5000/a", r"mlflow-artifacts://elsewhere\@127.0.0.1:5000/a"),
        *("http://else where@127.0.0.1:5000/a", "http://127.0.0.1:5000\t@elsewhere/a", "http:elsewhere/a", "http:///a"),
    ],
)
def test_password_is_sent_to_no_server_that_a_run_names_for_its_artifacts(uri, store):
    with pytest.raises(UntrustedError, match=re.escape(f"the artifacts are in {printable(uri)}, but ")):
        check_artifact_address(uri, store)
    for own in ("/a", "/my folder/a", "file:///a", "s3://bucket/a", "s3://bucket/my folder/a"):
        check_artifact_address(own, store)


@pytest.mark.parametrize(
    "uri", ["mlflow-artifacts:/0/a", "mlflow-artifacts:/0/a b", f"{STORE}/api/2.0/mlflow-artifacts/artifacts/0/a"]
)
def test_artifacts_may_be_on_the_server_of_their_store_alone(uri):
    for store in (STORE, STORE.replace("http://", "http://me@")):
        check_artifact_address(uri, store)
    with pytest.raises(UntrustedError, match="another would be sent this user's password"):
        check_artifact_address(uri, "sqlite:////mlruns.db")
