"""Words of unit files: split and quoted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.properties.syntax import escape_specifiers, quote_word, split_words

words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", []),
        ("  a  b ", ["a", "b"]),
        ("'a b' \"c d\"e", ["a b", "c de"]),
        ("'' \"\"", ["", ""]),
        (r"a\nb \x41 \u00e4 \101 \s \\ \q", ["a\nb", "A", "ä", "A", " ", "\\", "q"]),
        ('"it\'s" \'say "x"\'', ["it's", 'say "x"']),
        ("a\tb\nc", ["a", "b", "c"]),
    ],
)
def test_words(text: str, expected: list[str]) -> None:
    assert split_words(text) == expected


@pytest.mark.parametrize("text", ["'a", '"', "a\\", r"\x00", r"\ud800", r"\U00110000"])
def test_unfinished_words(text: str) -> None:
    with pytest.raises(ValueError, match="a"):
        split_words(text)


@given(st.lists(words))
def test_quoted_and_split_again(given_words: list[str]) -> None:
    line = " ".join(quote_word(word) for word in given_words)
    assert line.isprintable() or not any(char < " " for char in line)
    assert split_words(line) == [escape_specifiers(word) for word in given_words]


@given(words)
def test_no_specifier_is_left(text: str) -> None:
    assert escape_specifiers(text).count("%") % 2 == 0


@given(st.text())
def test_any_text_is_split_or_refused(text: str) -> None:
    try:
        split_words(text)
    except ValueError as error:
        assert str(error)
