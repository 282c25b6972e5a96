"""Untrusted YAML."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from armscan.utils.strict_yaml import DEEPEST, load_yaml

SCALARS = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text())
DOCUMENTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(), inner, max_size=5), max_leaves=20
)


@given(DOCUMENTS)
def test_plain_values_are_read_as_pyyaml_reads_them(document):
    text = yaml.safe_dump(document)
    assert load_yaml(text) == yaml.safe_load(text) == load_yaml(text.encode())


def test_aliases_and_merged_mappings_are_read():
    assert load_yaml("a: &a {x: 1}\nb: *a\nc: {<<: *a, x: 2}\nd: {<<: *a, <<: {y: 1}}") == {
        "a": {"x": 1},
        "b": {"x": 1},
        "c": {"x": 2},
        "d": {"x": 1, "y": 1},
    }


@pytest.mark.parametrize(
    "text",
    ["a: 1\na: 2", "- {b: {c: 1, c: 2}}", "a: &a [*a]", "a: &a {b: [*a]}", "&a {? [*a] : 1}"],
)
def test_mapping_with_a_key_twice_and_collection_in_itself_are_refused(text):
    with pytest.raises(ValueError, match=r"appears twice|has more than"):
        load_yaml(text)


def test_nesting_is_bounded():
    assert load_yaml("[" * DEEPEST + "]" * DEEPEST)
    with pytest.raises(ValueError, match=f"more than {DEEPEST} deep"):
        load_yaml("[" * (DEEPEST + 1) + "]" * (DEEPEST + 1))


@pytest.mark.parametrize("text", ["0x" + "F" * 6000, "1:" * 5000 + "1", "+1_" + "0" * 6000, f'!!int " {"1:" * 5000}1"'])
def test_long_numbers_are_refused_before_they_are_computed(text):
    with pytest.raises(ValueError, match=r"\.\.\. has \d+ characters, but a number has at most 1000"):
        load_yaml(f"a: {text}")


@pytest.mark.parametrize("text", ["010", "008", "-007", "1:30", "1_0", "1_0.5", "0_1"])
def test_numbers_that_yaml_reads_as_others_are_refused_unless_they_are_quoted(text):
    with pytest.raises(ValueError, match=rf'it holds {text}, which YAML would read as .* quotes \("{text}"\)'):
        load_yaml(f"a: [{text}]")
    assert load_yaml(f"a: ['{text}']") == {"a": [text]}


@pytest.mark.parametrize(
    "text", ["0", "-0.5", "00.5", "10", "0x1F", "1.0e-05", "00001_labels.nii.gz", "2024-01-02", "a_1"]
)
def test_other_numbers_and_names_are_read(text):
    assert load_yaml(f"a: {text}") == yaml.safe_load(f"a: {text}")


def test_long_text_is_read():
    words, digits = "9 words, " * 200 + "end", "1" * 6000
    assert load_yaml(yaml.safe_dump([words, digits])) == [words, digits]


@pytest.mark.parametrize("width", [2, 9])
def test_aliases_that_multiply_are_refused_before_anything_is_built(width):
    lines = ["a0: &a0 [x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * width)}]" for i in range(1, 40))]
    with pytest.raises(ValueError, match="has more than"):
        load_yaml("\n".join(lines))


@pytest.mark.parametrize("text", ["!!python/object/apply:os.getcwd []", "!!python/name:os.system", "a: [", "\0"])
def test_what_is_more_or_less_than_plain_yaml_is_refused(text):
    with pytest.raises(yaml.YAMLError):
        load_yaml(text)
