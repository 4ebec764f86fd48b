"""Selectors, nodes and runs, looked up in a journal of our own."""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from types import SimpleNamespace

import pytest

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.query import UNIT_ENDS, LogQuery
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs import logs
from dora_systemd.verbs.logs import FollowedLog, find_query

ROBOT = "550e8400-e29b-41d4-a716-446655440000"
ARM = "550e9999-e29b-41d4-a716-446655440000"
QUERY = LogQuery(Scope(is_user=False, uid=0))


class FakeJournal(JournalReader):
    def known_names(self) -> list[str]:
        return ["arm", "robot", "550e"]

    def known_uuids(self) -> list[str]:
        return [ROBOT, ARM]

    def known_nodes(self, name: str) -> list[str]:
        return ["cam-left", "cam-right", "sink"] if name == "robot" else []

    def name_of(self, uuid: str) -> str:
        return {ROBOT: "robot", ARM: "arm"}[uuid]

    def has_run(self, name: str, run: str) -> bool:
        return (name, run) == ("robot", "0190-run")

    def invocations(self, scope: Scope, name: str, uuid: str) -> Iterator[str]:
        del scope, uuid
        return iter(["i2", "i1"] if name == "robot" else [])


def find(selector: str = "robot", nodes: tuple[str, ...] = (), run: str = "ALL") -> LogQuery:
    return find_query(FakeJournal(), QUERY, selector, nodes, run)


@pytest.mark.parametrize(
    ("selector", "name", "uuid"),
    [
        ("robot", "robot", ""),
        ("dora-robot.service", "robot", ""),
        (ROBOT, "robot", ROBOT),
        ("550e84", "robot", ROBOT),
        ("550E99", "arm", ARM),
        ("550e", "550e", ""),
        ("", "", ""),
    ],
)
def test_selector(selector: str, name: str, uuid: str) -> None:
    query = find(selector)
    assert (query.name, query.uuid) == (name, uuid)


@pytest.mark.parametrize(
    ("selector", "hint"),
    [
        ("robto", "did you mean robot?"),
        ("zzz", "known dataflows: 550e, arm, robot"),
        *(("550e-", ""), ("5", ""), ("\n", ""), ("../x", ""), ("é", "")),
    ],
)
def test_wrong_selector(selector: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find(selector)
    assert caught.value.code is ExitCode.NOT_FOUND
    assert hint in caught.value.hint


def test_ambiguous_uuid() -> None:
    class WithoutThatName(FakeJournal):
        def known_names(self) -> list[str]:
            return ["arm", "robot"]

    with pytest.raises(DoraSystemdError) as caught:
        find_query(WithoutThatName(), QUERY, "550e")
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint == f"one of {ROBOT} (robot), {ARM} (arm)"


@pytest.mark.parametrize(
    ("patterns", "nodes"),
    [
        (("sink",), ("sink",)),
        (("cam-*",), ("cam-left", "cam-right")),
        (("*right", "sink", "sink"), ("cam-right", "sink")),
        (("cam-[lr]*t",), ("cam-left", "cam-right")),
    ],
)
def test_nodes(patterns: tuple[str, ...], nodes: tuple[str, ...]) -> None:
    assert find(nodes=patterns).nodes == nodes


def test_unknown_node_lists_the_known_ones() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find(nodes=("sink", "nope*"))
    assert caught.value.code is ExitCode.NOT_FOUND
    assert caught.value.hint == "nodes: cam-left, cam-right, sink"
    with pytest.raises(DoraSystemdError) as caught:
        find("arm", nodes=("x",))
    assert caught.value.hint == "no node has written anything yet"


def test_run() -> None:
    assert find(run="CURRENT").invocation == "i2"
    assert find(run="PREVIOUS").invocation == "i1"
    assert find(run="0190-run").run == "0190-run"
    for selector, run in (("arm", "CURRENT"), ("arm", "0190-run"), ("robot", "nosuch")):
        with pytest.raises(DoraSystemdError, match="cannot find the") as caught:
            find(selector, run=run)
        assert caught.value.code is ExitCode.NOT_FOUND


@pytest.mark.parametrize(("nodes", "run"), [(("a",), "ALL"), ((), "CURRENT")])
def test_nodes_and_runs_are_those_of_one_dataflow(nodes: tuple[str, ...], run: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find("", nodes=nodes, run=run)
    assert caught.value.code is ExitCode.USAGE


def test_lines_go_on_after_an_automatic_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()

    @contextmanager
    def journalctl(*_: object, **__: object) -> Iterator[SimpleNamespace]:
        with os.fdopen(reading, "rb") as stdout:
            yield SimpleNamespace(stdout=stdout)

    monkeypatch.setattr(logs, "open_journalctl", journalctl)
    printed: list[bytes] = []
    log = FollowedLog(QUERY.scope, "robot", ROBOT, 0, printed.append, lambda one: one["MESSAGE"])
    end = b"MESSAGE_ID=%s\nMESSAGE=end\n\n" % UNIT_ENDS[1].encode()
    with closing(log):
        os.write(writing, b"MESSAGE=one\n\n" + end)
        log.print_new()
        assert log.has_ended
        os.write(writing, b"MESSAGE=two\n\n" + end)
        log.finish()
        log.print_new()
    assert (printed, log.has_ended) == ([b"one", b"two"], True)
    os.close(writing)
