"""What the commands of key=value words share."""

import pytest

from armscan.errors import InvalidValueError, VolumeError
from armscan.words import answered, read_words


def test_read_words_takes_texts_as_they_are_and_parses_the_others():
    words = ["path=007[${x}", "names=[a,b]", "flag=true", "number=3", "number=4", "text=a=b"]
    assert read_words(words, ("path", "names", "flag", "number", "text"), texts=("path", "text")) == {
        "path": "007[${x}",
        "names": ["a", "b"],
        "flag": True,
        "number": 4,
        "text": "a=b",
    }


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("data", "'data' cannot be read: give key=value, with a key of data or list"),
        ("date=x", "there is no key 'date', but only data or list"),
        ("data=", "data is empty"),
        ("list=[a", "'list=\\[a' cannot be read"),
        ("list=${data}", "cannot be read"),
    ],
)
def test_read_words_refuses_what_it_cannot_read(word, message):
    with pytest.raises(InvalidValueError, match=message):
        read_words([word], ("data", "list"), texts=("data",))


def raising(error):
    def command(words):
        raise error

    return command


def test_answered_gives_the_code_of_the_command_or_explains_it(capsys):
    assert answered(len, ["a=1", "b=2"], usage="how", left="nothing") == 2
    assert answered(len, ["a=1", "--help"], usage="how", left="nothing") == 0
    assert capsys.readouterr().out == "how\n"


def test_answered_tells_a_mistake_or_an_interrupt_in_a_line(capsys):
    assert answered(raising(VolumeError("a: is no\n volume")), [], usage="", left="") == 2
    assert capsys.readouterr().err == "error: a: is no volume\n"
    assert answered(raising(KeyboardInterrupt()), [], usage="", left="all is there") == 130
    assert capsys.readouterr().err == "\ninterrupted; all is there\n"


def test_answered_hides_no_fault_of_the_program():
    with pytest.raises(ZeroDivisionError):
        answered(raising(ZeroDivisionError()), [], usage="", left="")
