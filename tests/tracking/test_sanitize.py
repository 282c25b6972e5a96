"""Names and values that MLflow accepts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mlflow.utils.validation import MAX_PARAM_VAL_LENGTH, MAX_TAG_VAL_LENGTH, _validate_param, _validate_tag

from armscan.tracking.sanitize import MAX_PARAM_CHARS, MAX_TAG_CHARS, name_of, params_of, tags_of, truncate
from tests.support.stores import store_in

KEYS = st.text(min_size=1, max_size=300) | st.from_regex(r"[a-z_]{1,9}(\.[a-z_]{1,9}){0,40}", fullmatch=True)


def test_limits_are_those_of_mlflow():
    assert (MAX_PARAM_CHARS, MAX_TAG_CHARS) == (MAX_PARAM_VAL_LENGTH, MAX_TAG_VAL_LENGTH)


@given(st.dictionaries(KEYS, st.text(max_size=50) | st.integers() | st.none(), max_size=5))
def test_params_of_any_configuration_are_taken_and_none_is_lost(config):
    params = params_of(config)
    assert len(params) == len(config)
    for name, value in params.items():
        _validate_param(name, value)


@given(KEYS)
def test_tags_of_any_name_are_taken(key):
    ((name, value),) = tags_of({key: "x" * (MAX_TAG_CHARS + 1)}).items()
    _validate_tag(name, value)
    assert len(value) == MAX_TAG_CHARS


@pytest.mark.parametrize("key", ["agent.lr", "env.transform.rz_deg", "volumes.training", "a b/c:d-e", "x" * 250])
def test_name_that_is_allowed_stays_as_it_is(key):
    assert name_of(key) == key


def test_value_that_is_cut_says_where_the_whole_is():
    config = {"sizes": list(range(3000)), "short": "a" * MAX_PARAM_CHARS}
    params = params_of(config)
    assert len(params["sizes"]) == MAX_PARAM_CHARS
    assert params["sizes"].startswith("[0, 1, 2")
    assert f" ... cut: config.yaml has all {len(str(config['sizes']))} characters (" in params["sizes"]
    assert params["short"] == config["short"]


def test_values_that_differ_after_the_cut_do_not_become_the_same():
    one, other = (params_of({"names": "x" * 7000 + end})["names"] for end in "ab")
    assert one != other


@given(st.text(max_size=200), st.integers(min_value=90, max_value=300))
def test_shortened_text_is_as_long_as_it_may_be_at_most(text, at_most):
    assert len(truncate(text, at_most, "file")) <= at_most
    assert truncate(text, at_most, "file") == text or len(text) > at_most


def test_params_too_long_for_a_store_reach_it(tmp_path, database):
    from armscan.tracking import TrackedRun

    store, experiment_id = store_in(tmp_path, "test")
    config = {
        "long": "b" * 10_000,
        "k" * 300: 1,
        "odd (key)": 2,
        "none": None,
        "empty": "",
        "many": {str(i): i for i in range(250)},
    }
    tags = {"overrides": "c" * 10_000}
    with TrackedRun.start(store, experiment_id, name="n", config=config, tags=tags, folder=tmp_path) as tracked:
        tracked.set_tags({"more": "d" * 10_000})
    data = store.get_run(tracked.run_id).data
    assert data.params == params_of(config)
    assert data.tags["overrides"].startswith("ccc")
    assert data.tags["more"].startswith("ddd")
