"""`args:` as dora splits it."""

import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.descriptor.arguments import split_arguments

CASES = {
    "": [],
    " \t\n": [],
    "a  b\tc\nd": ["a", "b", "c", "d"],
    "--name 'a b' \"c d\"": ["--name", "a b", "c d"],
    "''": [""],
    "a''b\"c\"": ["abc"],
    "one \\\ntwo": ["one", "two"],
    "a\\\nb": ["ab"],
    "a\\ b \\'": ["a b", "'"],
    '"a\\$b" "\\`" "\\"" "\\\\"': ["a$b", "`", '"', "\\"],
    '"a\\nb" "x\\\ny"': ["a\\nb", "xy"],
    "'a\\b'": ["a\\b"],
    "#ff0000": [],
    "--colour #ff0000\n--next": ["--colour", "--next"],
    "a#b '#c'": ["a#b", "#c"],
    "a\rb": ["a\rb"],
    "$HOME `x` *": ["$HOME", "`x`", "*"],
}


@pytest.mark.parametrize("text", CASES)
def test_as_dora(text: str) -> None:
    assert split_arguments(text) == CASES[text]


@pytest.mark.parametrize("text", ["'a", '"a', 'a "b\\"', "a\\", '"\\'])
def test_unfinished(text: str) -> None:
    with pytest.raises(ValueError, match=r"a quote is open|a backslash ends it"):
        split_arguments(text)


@given(st.lists(st.text(st.characters(codec="utf-8"))))
def test_quoted_words_come_back(words: list[str]) -> None:
    assert split_arguments(shlex.join(words)) == words
