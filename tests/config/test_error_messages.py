"""Users' mistakes in one line."""

import pytest
from hydra.errors import InstantiationException

from armscan.config.error_messages import one_line_message
from armscan.errors import InvalidValueError


def test_message_of_ours_stays_as_it_is():
    assert one_line_message(InvalidValueError("agent.lr is 0")) == "agent.lr is 0"


@pytest.mark.parametrize(("section", "key"), [("agent", "agent.lr"), ("agent.sac", "agent.sac.lr")])
def test_message_from_a_nested_section_names_its_keys(section, key):
    error = InstantiationException(f"Error in call to target\nfull_key: {section}")
    error.__cause__ = InvalidValueError("agent.lr is 0")
    assert one_line_message(error) == f"{key} is 0"


@pytest.mark.parametrize("part", ["vector", "images"])
def test_message_from_a_part_of_the_network_names_its_keys(part):
    error = InstantiationException(f"Error in call to target\nfull_key: agent.network.{part}")
    error.__cause__ = InvalidValueError("network.filters is 0")
    assert one_line_message(error) == f"network.{part}.filters is 0"


def test_error_from_another_process_and_without_a_traceback_is_no_mistake_of_the_user():
    assert one_line_message(ValueError("x")) is None


def test_text_that_is_no_configuration_is_not_called_one():
    with pytest.raises(UnicodeDecodeError) as raised:
        b"\xff".decode()
    assert one_line_message(raised.value).startswith("a file cannot be read: 'utf-8' codec can't decode byte 0xff")
