"""The lines of other machines while `start --attach` follows a dataflow."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dora_systemd.decisions.logs.records import Record
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.verbs.remote.attached import MemberLines, SharedLog

UUID = "550e8400-e29b-41d4-a716-446655440000"
HERE = Host("gpu", "")
LINE = """__REALTIME_TIMESTAMP={at}
DORA_DATAFLOW={uuid}
DORA_NODE={node}
SYSLOG_IDENTIFIER=whatever
MESSAGE={text}
{more}
"""
BEGUN_US = 1_700_000_000_000_000


def line(
    text: str, node: str = "mid", uuid: str = UUID, at: int = BEGUN_US + 7, more: str = ""
) -> str:
    return LINE.format(text=text, node=node, uuid=uuid, at=at, more=f"{more}\n" if more else "")


class Bench:
    """A doractl over there, whose output is `said`."""

    def __init__(self, root: Path, said: str, status: int) -> None:
        self.asked, self.warnings = root / "asked", list[str]()
        (root / "said").write_text(said)
        doractl = root / "doractl"
        doractl.write_text(f'#!/bin/sh\necho "$@" >>{self.asked}\ncat {root}/said\nexit {status}\n')
        doractl.chmod(0o755)
        told = (HERE, ("robot", UUID), ["mid"], BEGUN_US, self.warnings.append)
        self.lines = MemberLines(*told, pauses=(0.0, 0.0))

    def look_until(self, is_so: Callable[[list[Record]], bool]) -> list[Record]:
        found: list[Record] = []
        deadline = time.monotonic() + 60
        while not is_so(found):
            assert time.monotonic() < deadline, (found, self.warnings)
            found += self.lines.look()
            time.sleep(0.01)
        self.lines.close()
        return found

    def requests(self) -> list[str]:
        return self.asked.read_text().splitlines() if self.asked.exists() else []


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, int], Bench]:
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return lambda said, status: Bench(tmp_path, said, status)


def test_the_lines_of_its_own_nodes(bench: Callable[[str, int], Bench]) -> None:
    """A machine can say anything: of another node, of another dataflow, at any time."""
    strange = line("a", node="eye") + line("b", uuid=UUID.replace("5", "6"))
    event = line("c", more="DORA_EVENT=node-ready")
    one = bench(strange + event + line("got 1") + line("late", at=10**40), 1)
    found = one.look_until(lambda found: len(found) >= 2)[:2]
    assert [record["MESSAGE"] for record in found] == [b"got 1", b"late"]
    assert {record["SYSLOG_IDENTIFIER"] for record in found} == {b"robot/mid"}
    assert found[1]["__REALTIME_TIMESTAMP"] == b"0"
    assert one.requests()[0].startswith("logs robot --machine=head -f --since=")


def test_a_machine_that_is_away_is_said_once(bench: Callable[[str, int], Bench]) -> None:
    one = bench("", 1)
    one.look_until(lambda _: len(one.requests()) > 3)
    assert one.warnings == ["the lines of machine gpu are missing for now: exit status 1"]


def test_a_part_that_has_not_begun(bench: Callable[[str, int], Bench]) -> None:
    one = bench("", 4)
    one.look_until(lambda _: len(one.requests()) > 2)
    assert one.warnings == []


def test_what_was_shown_is_not_asked_for_again(bench: Callable[[str, int], Bench]) -> None:
    one = bench(line("got 1"), 1)
    one.look_until(lambda _: len(one.requests()) > 2)
    first, second = (
        request.partition("--since=")[2].split(" -a")[0] for request in one.requests()[:2]
    )
    assert first < second


def test_both_are_written(bench: Callable[[str, int], Bench]) -> None:
    one = bench(line("got 1"), 4)
    written: list[bytes] = []

    class Head:
        def fileno(self) -> int:
            return 7

        def print_new(self) -> None:
            if not written:
                written.append(b"head")

        def finish(self) -> None:
            written.append(b"end")

        def close(self) -> None:
            written.append(b"closed")

    log = SharedLog(Head(), written.append, lambda record: record["MESSAGE"])  # type: ignore[arg-type]
    log.others = [one.lines]
    deadline = time.monotonic() + 60
    while b"got 1" not in written:
        assert time.monotonic() < deadline
        log.print_new()
    log.finish()
    log.close()
    assert log.fileno() == 7
    assert written[0] == b"head"
    assert b"end" in written
    assert written[-1] == b"closed"
    assert not list(one.lines.look()), "nothing begins again"
