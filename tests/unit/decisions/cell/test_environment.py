"""Environment variables from flags and files."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.environment import (
    environment_entries,
    parse_assignment,
    unit_environment,
    with_place,
)
from dora_systemd.decisions.cell.environment_file import parse_environment_file
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
        "C": "a bcd",
        "D": "ab",
        "E": '$HOME "x"',
        "F": 'say "hi" $x \\n',
        "G": "",
    }


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ('{"a": 1}', '{"a": 1}'),
        ("it's", "it's"),
        ("5'10\"", "5'10\""),
        ('"x y" z', "x yz"),
        (r"a\ b", "a b"),
        ("x\\ ", "x "),
        ("  sp  ", "sp"),
        (r'"a\$b\n"', r"a$b\n"),
        ('a"b c"d', 'a"b c"d'),
        ("a\\\n b", "a b"),
        ('"a\\\nb"', "ab"),
        ("last\\", "last"),
    ],
)
def test_values_as_systemd_reads_them(line: str, value: str) -> None:
    """Compared with EnvironmentFile= of systemd 257."""
    assert parse_environment_file(f"# a \\\nA={line}", "x.env") == {"A": value}


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
    assert dict(map(parse_assignment, environment_entries(variables))) == variables


def test_what_a_prompt_has_and_systemd_does_not_set() -> None:
    given = {"A": "1", "PWD": "/given"}
    assert with_place(given, "/srv", "/") == {"A": "1", "PWD": "/given", "HOME": "/"}
    assert with_place({"HOME": "/home/a"}, "/srv", "") == {"HOME": "/home/a", "PWD": "/srv"}


def test_the_environment_of_a_unit() -> None:
    path = "/usr/bin:.:bin::/bin\n:/bin"
    assert unit_environment(path, None, {"A": "1"}) == {"PATH": "/usr/bin:/bin", "A": "1"}
    assert unit_environment("/bin", "/srv/.venv", {}) == {
        "PATH": "/srv/.venv/bin:/bin",
        "VIRTUAL_ENV": "/srv/.venv",
    }
    assert unit_environment("/bin", "/srv/.venv", {"PATH": "/x"})["PATH"] == "/x"
