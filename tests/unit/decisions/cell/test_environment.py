"""Environment variables from flags and files."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import (
    environment_entries,
    parse_assignment,
    parse_environment_file,
    unit_environment,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

keys = st.from_regex(r"X_[A-Z0-9_]{0,10}", fullmatch=True)
values = st.text(st.characters(exclude_categories=["Cs", "Cc"]))


@given(keys, values)
def test_assignments(key: str, value: str) -> None:
    assert parse_assignment(f"{key}={value}") == (key, value)


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "A",
            "=x",
            "1A=x",
            "A B=x",
            "Ä=x",
            "A=x\ny",
            "A=\x1b[0m",
            "A=\udcff",
            "A=\ufdd0",
            "A=\U0010fffe",
            "A\n=x",
        ),
        *("NOTIFY_SOCKET=/run/x", "INVOCATION_ID=x", "A=" + "x" * 131070),
    ],
)
def test_bad_assignments(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot set environment") as caught:
        parse_assignment(text)
    assert caught.value.code == ExitCode.USAGE
    assert caught.value.hint


def test_a_bad_value_is_not_shown() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_assignment("TOKEN=hunter2\n")
    assert "hunter2" not in caught.value.message + caught.value.hint


def test_an_environment_file() -> None:
    text = """\
# comment
; comment

A=1
B = 2
C="a b" 'c' d
D=a\\
b
E='$HOME "x"'
F="say \\"hi\\" \\$x \\n"
G=
A=3
"""
    assert parse_environment_file(text, "x.env") == {
        "A": "3",
        "B": "2",
        "C": "a b c d",
        "D": "ab",
        "E": '$HOME "x"',
        "F": 'say "hi" $x \\n',
        "G": "",
    }


def test_a_bad_line_is_named_and_not_shown() -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot read line 2 of x\.env as") as caught:
        parse_environment_file("A=1\nhunter2\n", "x.env")
    assert "hunter2" not in caught.value.message + caught.value.hint
    assert caught.value.code == ExitCode.BAD_INPUT


def test_an_open_quote_is_refused() -> None:
    with pytest.raises(DoraSystemdError, match="line 1"):
        parse_environment_file('KEY="-----BEGIN\nPRIVATE-----"\n', "x.env")


@given(st.text())
def test_any_file_is_read_or_refused(text: str) -> None:
    try:
        variables = parse_environment_file(text, "x.env")
    except DoraSystemdError:
        return
    for entry in environment_entries(variables):
        parse_assignment(entry)


def test_the_environment_of_a_unit() -> None:
    path = "/usr/bin:.:bin::/bin\n:/bin"
    assert unit_environment(path, None, {"A": "1"}) == {"PATH": "/usr/bin:/bin", "A": "1"}
    assert unit_environment("/bin", "/srv/.venv", {}) == {
        "PATH": "/srv/.venv/bin:/bin",
        "VIRTUAL_ENV": "/srv/.venv",
    }
    assert unit_environment("/bin", "/srv/.venv", {"PATH": "/x"})["PATH"] == "/x"
