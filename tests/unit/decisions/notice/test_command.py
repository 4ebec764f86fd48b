"""The words of on_failure: what is taken, what is refused, and that no shell is in between."""

from pathlib import PurePath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.options import format_runner_argv, parse_runner_argv
from dora_systemd.decisions.notice.command import (
    checked_words,
    format_words,
    parse_words,
    unit_of,
    words_of,
)
from dora_systemd.decisions.settings.on_failure import ON_FAILURE
from dora_systemd.errors import DoraSystemdError
from tests.unit.fakes.manager import options

printable = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=20)


@given(st.lists(printable.filter(lambda one: not one.startswith("unit:")), min_size=1, max_size=5))
def test_words_and_back(words: list[str]) -> None:
    assert parse_words(format_words(tuple(words))) == tuple(words)
    told = options().with_value("on_failure", tuple(words))
    assert words_of(parse_runner_argv(format_runner_argv(told))) == tuple(words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("notify --urgent", ("notify", "--urgent")),
        ("notify '$(reboot) `x` ; y'", ("notify", "$(reboot) `x` ; y")),
        ("unit:tell@.service", ("unit:tell@.service",)),
    ],
)
def test_text_is_split_and_nothing_is_expanded(text: str, words: tuple[str, ...]) -> None:
    assert parse_words(text) == words


@pytest.mark.parametrize(
    "words",
    [
        [],
        [""],
        ["  "],
        ["notify", "two\nlines"],
        ["notify\0"],
        ["notify", "x" * 70_000],
        ["unit:tell"],
        ["unit:../tell.service"],
        ["unit:tell.service", "word"],
        ["unit:a@b@c.service"],
        ["unit:dora-robot.service"],
        ["unit:doranotice@robot.service"],
    ],
)
def test_refused_words(words: list[str]) -> None:
    with pytest.raises(DoraSystemdError, match="as on_failure"):
        checked_words(words)


def test_an_open_quotation_mark() -> None:
    with pytest.raises(DoraSystemdError, match="as on_failure") as refused:
        parse_words("notify 'robot")
    assert "quotation mark" in refused.value.hint


def test_instance_of_a_template() -> None:
    assert unit_of(("unit:tell@.service",), "robot") == "tell@robot.service"
    assert unit_of(("unit:tell@x.service",), "robot") == "tell@x.service"
    assert unit_of(("/bin/tell",), "robot") == ""
    assert unit_of((), "robot") == ""


def test_relative_programs_begin_at_the_settings_file() -> None:
    parse = ON_FAILURE.kind.parse
    assert parse(["bin/tell", "a/b"], PurePath("/srv/robot")) == ("/srv/robot/bin/tell", "a/b")
    assert parse("tell a/b", PurePath("/srv/robot")) == ("tell", "a/b")
    assert parse("/bin/tell", PurePath("/srv/robot")) == ("/bin/tell",)
    assert ON_FAILURE.kind.format(("/bin/tell", "a b")) == ["/bin/tell 'a b'"]
    assert ON_FAILURE.kind.format(()) == []


def test_only_root_names_a_unit() -> None:
    assert ON_FAILURE.raises
    assert ON_FAILURE.raises(("unit:tell.service",))
    assert not ON_FAILURE.raises(("/bin/tell",))
    assert not ON_FAILURE.raises(())
