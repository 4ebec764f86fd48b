"""The command line of `doractl logs`: letters mean what they mean in journalctl."""

import pytest

from dora_systemd.cli.group import doractl, run_verb
from dora_systemd.cli.verbs.look.logs import command, last_count
from dora_systemd.errors import DoraSystemdError, ExitCode


@pytest.mark.parametrize(
    ("words", "boot", "selectors"),
    [
        ("", "", ()),
        ("robot", "", ("robot",)),
        ("-b", "0", ()),
        ("-b robot", "0", ("robot",)),
        ("robot -b", "0", ("robot",)),
        ("-b -1 robot", "-1", ("robot",)),
        ("-b-1 robot arm", "-1", ("robot", "arm")),
        ("--boot robot", "0", ("robot",)),
        ("--boot=-2 robot", "-2", ("robot",)),
        ("--boot all robot", "all", ("robot",)),
        ("-qb robot", "0", ("robot",)),
        (f"-b {'a' * 32} robot", "a" * 32, ("robot",)),
        ("-b -f robot", "0", ("robot",)),
        ("-b --node camera robot", "0", ("robot",)),
    ],
)
def test_boot(words: str, boot: str, selectors: tuple[str, ...]) -> None:
    params = command.make_context("logs", words.split(), **doractl.context_settings).params
    assert (params["boot"], params["selectors"]) == (boot, selectors)


@pytest.mark.parametrize("option", ["-n 5", "-n5", "--lines 5", "--lines=5", "--tail=5", "-qn 5"])
def test_lines(option: str) -> None:
    params = command.make_context(
        "logs", [*option.split(), "robot"], **doractl.context_settings
    ).params
    assert (params["counts"], params["selectors"]) == (("5",), ("robot",))


@pytest.mark.parametrize(
    ("values", "count"),
    [((), ""), (("5",), "5"), (("0",), "0"), (("5", "7"), "7"), (("all",), "all")],
)
def test_numbers(values: tuple[str, ...], count: str) -> None:
    assert last_count(values) == count


@pytest.mark.parametrize("value", ["-1", "+5", "", "camera", "é", "--node"])
def test_no_number(value: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        last_count((value,))
    assert caught.value.code is ExitCode.USAGE


@pytest.mark.parametrize("words", ["-f --until now robot", "--until 5m --follow"])
def test_what_follows_has_no_last_moment(words: str) -> None:
    """journalctl 257 prints what there is up to then, and waits forever."""
    with pytest.raises(DoraSystemdError, match="cannot use --follow with --until") as caught:
        run_verb(["logs", *words.split()])
    assert caught.value.code is ExitCode.USAGE
