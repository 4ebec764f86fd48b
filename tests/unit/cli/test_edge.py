"""What doractl prints for somebody who has called it from another machine."""

import io
import os

import pytest

from dora_systemd.cli import edge, group
from dora_systemd.cli.edge import Edge, with_target, write_view


@pytest.mark.parametrize(
    ("text", "there"),
    [
        ("Use 'doractl stop robot' to stop", "Use 'doractl -H a@b:7 stop robot' to stop"),
        ("hint: run: doractl --user restart x; doractl list", None),
        ("the same version of doractl on both", "the same version of doractl on both"),
        ("doractl: no dataflow named 'x'", "doractl: no dataflow named 'x'"),
        ("doractl -H c why x", "doractl -H c why x"),
        *(
            (record, record)
            for record in (
                "stopped by root (doractl stop)",
                "stopped by root, by sudo of ann (doractl node stop)",
                '"by": "root (doractl bundle)"',
                "it runs from /a.yml, started by doractl start",
                "# Written by doractl set.",
            )
        ),
        ("hint: on head: doractl stop robot", "hint: on head: doractl stop robot"),
        ("the gateway, see doractl env", "the gateway, see doractl env on a@b:7"),
        ("or doractl --user env for it", "or doractl --user env on a@b:7 for it"),
    ],
)
def test_commands_are_for_the_host_they_are_about(text: str, there: str | None) -> None:
    wanted = there or "hint: run: doractl -H a@b:7 --user restart x; doractl -H a@b:7 list"
    assert with_target(text, "a@b:7") == wanted
    assert with_target(text, "") == text


@pytest.mark.parametrize(
    ("text", "there"),
    [
        ("hint: doractl why x; sudo doractl stop x", "doractl --system why x; sudo doractl stop x"),
        ("doractl --user list", "doractl --user list"),
        ("stopped by root (doractl stop)", "stopped by root (doractl stop)"),
        ("see doractl env", "see doractl --system env"),
        ("on head: doractl stop x", "on head: doractl --system stop x"),
        ("1 (doractl list --user)", "1 (doractl list --user)"),
        ("1 (doractl list --all)", "1 (doractl --system list --all)"),
    ],
)
def test_commands_are_in_the_scope_they_are_about(text: str, there: str) -> None:
    assert with_target(text, "", "--system").removeprefix("hint: ") == there


def test_a_command_in_a_scope_of_another_host() -> None:
    wanted = "doractl -H a --system why x, doractl -H a --user restart x, doractl --system env on a"
    text = "doractl why x, doractl --user restart x, doractl env"
    assert with_target(text, "a", "--system") == wanted


@pytest.mark.parametrize("is_user", [True, False])
def test_a_scope_is_in_commands_unless_it_is_the_default(is_user: bool) -> None:
    edge.remember_scope(is_user)
    named = Edge.scope
    edge.remember_scope(os.getuid() != 0)
    assert Edge.scope == ""
    is_default = is_user == (os.getuid() != 0)
    assert named == ("" if is_default else "--user" if is_user else "--system")


def test_all_verbs_are_known() -> None:
    assert set(edge.VERBS) == {*group.VERBS, *group.ALIASES}


def test_a_report_for_another_host() -> None:
    stream = Edge(io.BytesIO(), encoding="utf-8")
    stream.reached_as = "a@b:7"
    write_view(stream, "\x1b[1mfix x, then run: doractl restart x\x1b[0m\n")
    stream.seek(0)
    assert stream.read() == "\x1b[1mfix x, then run: doractl -H a@b:7 restart x\x1b[0m\n"
