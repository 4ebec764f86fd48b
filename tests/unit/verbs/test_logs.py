"""Selectors, nodes and runs, looked up in a journal of our own."""

import os
import select
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from dora_systemd.adapters.journal.reader import JournalReader
from dora_systemd.decisions.logs.query import UNIT_ENDS, LogQuery, query_matches
from dora_systemd.decisions.logs.terminal import TerminalLines
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.recorded import find_query, find_soon
from dora_systemd.verbs.follow import UnitWatch
from dora_systemd.verbs.logs import FollowedLog, pass_logs, read_logs
from tests.unit.fakes.library import fake_journalctl, fake_systemd
from tests.unit.fakes.manager import FakeManager, options
from tests.unit.fakes.programs import make_program

ROBOT = "550e8400-e29b-41d4-a716-446655440000"
FORGED = "550e8499-e29b-41d4-a716-446655440000"
ARM = "550e9999-e29b-41d4-a716-446655440000"
QUERY = LogQuery(Scope(is_user=False, uid=0))


class FakeJournal(JournalReader):
    def known_names(self, scope: Scope) -> list[str]:
        del scope
        return ["arm", "robot", "550e"]

    def known_uuids(self) -> list[str]:
        return [ROBOT, FORGED, ARM]

    def known_nodes(self, scope: Scope, name: str, wanted: Sequence[str] = ()) -> list[str]:
        del scope, wanted
        return ["cam-left", "cam-right", "sink"] if name == "robot" else []

    def name_of(self, scope: Scope, uuid: str) -> str:
        del scope
        return {ROBOT: "robot", ARM: "arm"}.get(uuid, "")

    def has_run(self, scope: Scope, name: str, run: str) -> bool:
        del scope
        return (name, run) == ("robot", "0190-run")

    def invocations(self, scope: Scope, name: str, uuid: str) -> Iterator[str]:
        del scope, uuid
        return iter(["i2", "i1"] if name == "robot" else [])


def test_an_empty_name_is_not_all_dataflows() -> None:
    with pytest.raises(DoraSystemdError, match="no dataflow named ''"):
        find("")


def find(selector: str = "robot", nodes: tuple[str, ...] = (), run: str = "ALL") -> LogQuery:
    return find_query(FakeJournal(), QUERY, [selector], nodes, run)


@pytest.mark.parametrize(
    ("selector", "name", "uuid"),
    [
        ("robot", "robot", ""),
        ("dora-robot.service", "robot", ""),
        ("dora-robot", "robot", ""),
        (ROBOT, "robot", ROBOT),
        ("550e84", "robot", ROBOT),
        ("550E99", "arm", ARM),
        ("550e", "550e", ""),
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
        def known_names(self, scope: Scope) -> list[str]:
            del scope
            return ["arm", "robot"]

    with pytest.raises(DoraSystemdError) as caught:
        find_query(WithoutThatName(), QUERY, ["550e"])
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint == f"one of {ROBOT} (robot), {ARM} (arm)"


@pytest.mark.parametrize(
    ("selectors", "names"),
    [
        (("robot", "arm"), ["robot", "arm"]),
        (("*r*", "arm"), ["arm", "robot"]),
        (("robot", "dora-robot", "rob*"), ["robot"]),
        (("550E99", "robot"), ["arm", "robot"]),
    ],
)
def test_several_dataflows(selectors: tuple[str, ...], names: list[str]) -> None:
    query = find_query(FakeJournal(), QUERY, selectors)
    assert [query.name, *(one.name for one in query.others)] == names
    assert query_matches(query).count("+") == len(names) - 1


def test_a_pattern_without_a_match() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find_query(FakeJournal(), QUERY, ["robot", "cam*"])
    assert caught.value.code is ExitCode.NOT_FOUND


def test_nodes_of_several_dataflows() -> None:
    """A node needs to be in one of them."""
    query = find_query(FakeJournal(), QUERY, ["arm", "robot"], ["sink"])
    assert (query.name, query.nodes, query.others) == ("robot", ("sink",), ())
    with pytest.raises(DoraSystemdError) as caught:
        find_query(FakeJournal(), QUERY, ["arm", "robot"], ["nope"])
    assert caught.value.hint == "nodes: cam-left, cam-right, sink"


def test_levels_of_nodes() -> None:
    """Without --node, all nodes and the dataflow itself are shown, each from its level on."""
    query = replace(QUERY, levels={"sink": "err", "elsewhere": "debug"})
    found = find_query(FakeJournal(), query, ["robot"])
    assert found.nodes == ("", "cam-left", "cam-right", "sink")
    assert find_query(FakeJournal(), query, ["robot"], ["sink"]).nodes == ("sink",)
    with pytest.raises(DoraSystemdError) as caught:
        find_query(FakeJournal(), query, [])
    assert caught.value.code is ExitCode.USAGE


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
    assert find(run="PREVIOUS").invocation == find(run="previous").invocation == "i1"
    assert find(run="all") == find()
    assert [find(run=one).invocation for one in ("0", "-1")] == ["i2", "i1"]
    with pytest.raises(DoraSystemdError, match="cannot find the run -7 of dataflow"):
        find(run="-7")
    for other in ("1", "-", "-01", "-x"):
        with pytest.raises(DoraSystemdError, match=f"cannot find the run '{other}'") as refused:
            find(run=other)
        assert refused.value.hint.startswith("doractl logs robot --events shows when each")
    assert find(run="0190-run").run == "0190-run"
    for selector, run in (("arm", "CURRENT"), ("arm", "0190-run"), ("robot", "nosuch")):
        with pytest.raises(DoraSystemdError, match="cannot find the") as caught:
            find(selector, run=run)
        assert caught.value.code is ExitCode.NOT_FOUND


@pytest.mark.parametrize(("nodes", "run"), [(("a",), "ALL"), ((), "CURRENT")])
def test_nodes_and_runs_are_those_of_one_dataflow(nodes: tuple[str, ...], run: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        find_query(FakeJournal(), QUERY, [], nodes, run)
    assert caught.value.code is ExitCode.USAGE


def entry(us: int) -> bytes:
    return f"__REALTIME_TIMESTAMP={us}\nMESSAGE=x\n\n".encode()


@pytest.mark.parametrize(
    ("given", "is_asked"),
    [
        ({"grep": "x", "tail": "2"}, True),
        ({"grep": "x", "tail": "2", "is_follow": True}, False),
        ({"grep": "x", "tail": "2", "is_reverse": True}, False),
        ({"grep": "x", "tail": "all"}, False),
        ({"grep": "x"}, False),
        ({"tail": "2"}, False),
    ],
)
def test_found_lines_come_in_the_order_of_time(
    given: dict[str, Any], is_asked: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """journalctl reverses --grep with --lines: ask it when these lines were, then for that time."""
    calls = fake_journalctl(monkeypatch, tmp_path, entry(5_000_000) + entry(3_000_000))
    with (tmp_path / "out").open("wb") as out:
        assert pass_logs(replace(QUERY, name="robot", **given), out.fileno()) == 0
    *first, last = calls.read_text().splitlines()
    assert len(first) == is_asked
    if is_asked:
        assert "--lines=2" in first[0]
        assert "--since=@3.000000 --until=@5.000000 --grep=x --" in last


@pytest.mark.parametrize(
    ("printed", "count"),
    [
        (b"lab robot/a[1]: [12B blob data]\n" * 3000, 1),
        (b"lab robot/a[1]: [1.7K blob data]\n", 1),
        (b"lab robot/a[1]: text\n", 0),
    ],
)
def test_a_pipe_hears_once_what_journalctl_leaves_out(
    printed: bytes, count: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake_journalctl(monkeypatch, tmp_path, printed)
    left_out: list[int] = []
    with (tmp_path / "out").open("wb") as out:
        pass_logs(QUERY, out.fileno(), lambda: left_out.append(1))
    assert (len(left_out), (tmp_path / "out").read_bytes()) == (count, printed)


def test_a_terminal_is_shown_all(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Escaped; without colours none of the nodes pass."""
    line = b"Nov 21 01:02:59 lab robot/a[1]: caf\xe9 \x1b[31mred\x1b[0m \x1b]2;x\x07\n"
    calls = fake_journalctl(monkeypatch, tmp_path, line)
    status: list[int] = []
    lines = read_logs(QUERY, TerminalLines(want_colors=False), on_end=status.append)
    shown = b"".join(lines)
    assert status == [0]
    assert shown == b"Nov 21 01:02:59 a caf\\xe9 red \\x1b]2;x\\x07\n"
    assert "--all" in calls.read_text().split()


def test_a_full_disk_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of which journalctl says nothing."""
    fake_journalctl(monkeypatch, tmp_path, b"a line\n")
    with Path("/dev/full").open("wb") as full, pytest.raises(OSError, match="No space left"):
        pass_logs(QUERY, full.fileno())


def test_a_followed_log_ends_with_its_reader(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As journalctl does: else `logs --follow | head -1` would wait for another line."""
    make_program(tmp_path / "journalctl", "#!/bin/sh\necho a line\nexec sleep 60\n")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    reader, writer = os.pipe()

    def read_one() -> None:
        os.read(reader, 100)
        os.close(reader)

    reading = Thread(target=read_one)
    reading.start()
    with pytest.raises(BrokenPipeError):
        pass_logs(replace(QUERY, is_follow=True), writer)
    reading.join()
    os.close(writer)


def test_nothing_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = fake_journalctl(monkeypatch, tmp_path, b"")
    with (tmp_path / "out").open("wb") as out:
        pass_logs(replace(QUERY, grep="x", tail="2"), out.fileno())
    assert "--grep=x --lines=2 --" in calls.read_text().splitlines()[-1]


def test_lines_go_on_after_journalctl_has_died(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With the record after the last whole one; and nothing is asked meanwhile."""
    calls, script = tmp_path / "calls", tmp_path / "journalctl"
    make_program(
        script,
        f"""echo "$@" >>{calls}
case "$*" in
*--after-cursor=s=1*) printf 'MESSAGE=two\\n\\n'; exec sleep 60;;
*) printf '__CURSOR=s=1\\nMESSAGE=one\\n\\nMESSAGE=hal';;
esac
""",
    )
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    printed: list[bytes] = []
    log = FollowedLog(QUERY.scope, "robot", ROBOT, 0, printed.append, lambda one: one["MESSAGE"])
    with closing(log):
        number, turns, end = log.fileno(), 0, time.monotonic() + 20
        poll = select.poll()
        poll.register(number, select.POLLIN)
        while b"two" not in printed and time.monotonic() < end:
            poll.poll(50)
            log.print_new()
            turns += 1
        assert log.fileno() == number
    assert printed == [b"one", b"two"]
    assert turns < 200, "it spins"
    assert len(calls.read_text().splitlines()) == 2


def test_a_watch_goes_on_after_journalctl_has_died(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nothing is new then: `logs --until-end` asks systemd instead."""
    calls = fake_journalctl(monkeypatch, tmp_path, b"")
    with closing(UnitWatch(QUERY.scope, "robot", 0)) as watch:
        watch.wait(20)
        assert not watch.wait(0)
        assert not watch.wait(0.1)
        assert len(calls.read_text().splitlines()) == 1
        watch._due = 0  # the pause is over
        watch.wait(20)
        assert len(calls.read_text().splitlines()) == 2


def test_lines_go_on_after_an_automatic_restart(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "lines")
    writing = os.open(tmp_path / "lines", os.O_RDWR)
    make_program(tmp_path / "journalctl", f"exec cat {tmp_path}/lines")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    printed: list[bytes] = []
    log = FollowedLog(QUERY.scope, "robot", ROBOT, 0, printed.append, lambda one: one["MESSAGE"])
    end = b"MESSAGE_ID=%s\nMESSAGE=end\n\n" % UNIT_ENDS[1].encode()
    with closing(log):
        os.write(writing, b"MESSAGE=one\n\n" + end)
        while not log.has_ended:
            assert log.is_readable(20)
            log.print_new()
        os.write(writing, b"MESSAGE=two\n\n" + end)
        while printed[-1] == b"one":
            assert log.is_readable(20)
            log.finish()
    assert (printed, log.has_ended) == ([b"one", b"two"], True)
    os.close(writing)


def test_journald_may_be_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataflow that systemd has loaded is looked for again; another one is not."""
    answers = iter([DoraSystemdError("no dataflow", "", ExitCode.NOT_FOUND)] * 2)

    def find() -> LogQuery:
        for error in answers:
            raise error
        return QUERY

    fake_systemd(monkeypatch, manager := FakeManager())
    manager.add(options(name="robot"))
    assert find_soon(find, QUERY.scope, ["robot"]) == QUERY
    answers = iter([DoraSystemdError("no dataflow", "", ExitCode.NOT_FOUND)])
    with pytest.raises(DoraSystemdError, match="no dataflow"):
        find_soon(find, QUERY.scope, ["camera"])
