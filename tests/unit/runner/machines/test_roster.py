"""What the head knows of its members."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.machines import Placed, format_missing, is_news
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.resources.usage import LineCount
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.machines.roster import Roster, with_dues
from dora_systemd.runner.nodes.watchdog import monotonic_us
from tests.unit.fakes.ends import FakeEnds
from tests.unit.fakes.loop import live

UUID = "550e8400-e29b-41d4-a716-446655440000"
OPTIONS = RunnerOptions(
    *("robot", UUID, "/srv/flow.yml", "/srv", "/bin/dora"),
    placed=(Placed("mid", "gpu"), Placed("eye", "cam")),
)
PORTS = wire.Forwards(61000, {"head": 61001, "gpu": 61002, "cam": 61003})
READY = wire.Ready("/run/dora-systemd/robot/work")


class Bench:
    def __init__(self) -> None:
        self.events: list[life.Event] = []
        self.roster = Roster(OPTIONS, PORTS)
        self.roster.push = self.events.append
        self.roster.set_facts("abcd", "1.1.0", is_awaited=True)

    async def link(self, machine: str = "gpu") -> FakeEnds:
        """A link of that machine, which has been heard."""
        other = FakeEnds()
        self.talk = asyncio.create_task(self.roster.link({"machine": machine}, other.ends))
        await settle()
        return other

    def heard(self) -> list[life.Event]:
        return [replace(one, at_us=0) for one in self.events]


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


def run(work: Callable[[Bench], Coroutine[Any, Any, None]]) -> None:
    live(lambda: work(Bench()))


def test_whether_all_could_start_again() -> None:
    async def work(bench: Bench) -> None:
        gone = await bench.roster.find_refusal("cdef")
        assert gone is not None
        assert gone.message == "cannot reach machine gpu: it is not connected yet"
        assert gone.code is ExitCode.NO_HOST
        links = {machine: await bench.link(machine) for machine in ("gpu", "cam")}
        for link in links.values():
            link.say(READY)
        await settle()

        async def answers(gpu: wire.Checked, cam: wire.Checked) -> DoraSystemdError | None:
            question = asyncio.create_task(bench.roster.find_refusal("cdef"))
            await settle()
            assert links["cam"].heard()[-1] == {"type": "check", "digest": "cdef"}
            links["gpu"].say(gpu)
            links["cam"].say(cam)
            return await question

        assert await answers(wire.Checked(), wire.Checked()) is None
        other = await answers(wire.Checked(), wire.Checked("another file", "copy it"))
        assert other is not None
        assert (other.message, other.hint) == ("machine cam: another file", "copy it")
        silent = await bench.roster.find_refusal("cdef", 0.01)
        assert silent is not None
        assert silent.message == "cannot reach machine gpu: it does not answer"

    run(work)


def test_a_new_table_is_shown_soon() -> None:
    """One that comes a hundred times a second is not written as often."""

    async def work(bench: Bench) -> None:
        written = asyncio.Event()
        times: list[int] = []

        def refresh() -> None:
            times.append(1)
            written.set()

        bench.roster.refresh = refresh
        other = await bench.link()
        for _ in range(50):
            other.say(wire.Table(CellStatus(lines={"mid": LineCount(7)}).to_json()))
        await settle()
        await written.wait()
        assert len(times) < 5
        node = NodeStatus("running", machine="gpu")
        table = bench.roster.amend(CellStatus(nodes={"mid": node}))
        assert table.lines == {"mid": LineCount(7)}

    run(work)


def test_a_link_gets_the_ports_and_then_its_part() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        assert [one["type"] for one in other.heard()] == ["forwards"]
        bench.roster.set_token("secret")
        assert [one["type"] for one in other.heard()] == ["forwards", "part"]
        part = other.heard()[1]
        told = (part["machine"], part["zenoh"], part["token"], part["digest"], part["uuid"])
        assert told == ("gpu", 61002, "secret", "abcd", UUID)

    run(work)


def test_a_member_that_is_ready_is_not_missing() -> None:
    async def work(bench: Bench) -> None:
        bench.roster.set_token("secret")
        other = await bench.link()
        assert bench.roster.missing()["gpu"] == "it has not answered yet"
        other.say(READY)
        await settle()
        assert bench.roster.missing() == {"cam": "it is not connected yet"}
        assert bench.roster.works()["gpu"] == READY.work
        assert bench.heard() == [life.MachineJoined(0, "gpu")]

    run(work)


def test_a_member_that_ends_without_a_word() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY)
        other.reader.feed_eof()
        await settle()
        assert bench.heard()[1:] == [life.MachineLost(0, "gpu", "the connection has ended")]
        assert bench.roster.silent() == ["gpu", "cam"]

    run(work)


def test_a_member_that_has_ended_in_peace_is_not_lost() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        # What its link says after that is the end of what has left.
        other.say(READY, wire.Ended(), wire.Lost(wire.RUNNER_ENDED))
        other.reader.feed_eof()
        await settle()
        assert bench.heard() == [life.MachineJoined(0, "gpu")]
        assert "gpu" in bench.roster.missing()

    run(work)


def test_the_last_words_count_once() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        reason = "the dora daemon is gone (signal SIGKILL)"
        other.say(READY, wire.Ended(reason, failed=1), wire.Lost("bye"))
        other.reader.feed_eof()
        await settle()
        assert bench.heard()[1:] == [life.MachineLost(0, "gpu", reason, is_failure=True)]

    run(work)


def test_a_member_that_goes_on_after_its_end_is_not_heard() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY, READY, wire.Ended("gone"), READY)
        await settle()
        await settle()
        assert [type(one).__name__ for one in bench.heard()] == ["MachineJoined", "MachineLost"]

    run(work)


def test_what_ssh_says_is_shown_until_the_member_is_ready() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(wire.Lost("connect to host gpu port 22: No route to host"))
        other.reader.feed_eof()
        await settle()
        assert bench.roster.missing()["gpu"] == "connect to host gpu port 22: No route to host"
        assert bench.heard() == []
        await bench.link()
        assert "No route" in bench.roster.missing()["gpu"]
        bench.roster.set_token("secret")
        assert "No route" in bench.roster.missing()["gpu"]

    run(work)


def refusals(bench: Bench) -> list[tuple[str, Cause]]:
    return [(one.reason, one.cause) for one in bench.events if isinstance(one, life.Refused)]


@pytest.mark.parametrize(
    ("tries", "is_awaited", "most"), [(0, False, 1), (1, True, 1), (2, True, 2), (1, False, None)]
)
def test_a_machine_that_is_not_reached(tries: int, is_awaited: bool, most: int | None) -> None:
    """A person who waits hears it soon; a robot that boots waits for its network."""

    async def work(bench: Bench) -> None:
        bench.roster.is_awaited = is_awaited
        for number in range(1, 4):
            other = await bench.link()
            other.say(wire.Unreached("cannot reach b: no such host", "correct it", tries))
            await settle()
            has_ended = most is not None and number >= most
            assert bool(refusals(bench)) is has_ended
            if has_ended:
                reason = "machine gpu: cannot reach b: no such host; hint: correct it"
                assert refusals(bench)[0] == (reason, Cause.NO_MACHINE)
                return
        assert bench.roster.missing()["gpu"] == "cannot reach b: no such host"

    run(work)


def test_attempts_count_in_a_row() -> None:
    """A machine that has been there is not given up for what failed before."""

    async def work(bench: Bench) -> None:
        unreached = wire.Unreached("cannot reach b: no route", "", 2)
        for said in ((unreached,), (READY,), (unreached,)):
            other = await bench.link()
            other.say(*said)
            await settle()
        assert refusals(bench) == []
        (await bench.link()).say(unreached)
        await settle()
        assert refusals(bench) == [("machine gpu: cannot reach b: no route", Cause.NO_MACHINE)]

    run(work)


@pytest.mark.parametrize(
    ("is_awaited", "cause"), [(True, Cause.NO_MACHINE), (False, Cause.MACHINE_LOST)]
)
def test_a_port_that_is_taken_there(is_awaited: bool, cause: Cause) -> None:
    """Another run has other ports; a machine that forwards none is not asked for ever."""

    async def work(bench: Bench) -> None:
        bench.roster.is_awaited = is_awaited
        for _ in range(4):
            assert {type(one) for one in bench.heard()} <= {life.ReloadAsked}
            other = await bench.link()
            other.say(wire.Taken("cannot forward a port to b: 61000", ""))
            await settle()
        assert len(bench.heard()) == 4
        assert refusals(bench) == [("machine gpu: cannot forward a port to b: 61000", cause)]

    run(work)


def test_a_link_that_has_its_ports_gets_none() -> None:
    async def work(bench: Bench) -> None:
        other = FakeEnds()
        request = {"machine": "gpu", "greeted": True}
        bench.talk = asyncio.create_task(bench.roster.link(request, other.ends))
        await settle()
        bench.roster.set_token("secret")
        assert [one["type"] for one in other.heard()] == ["part"]

    run(work)


def test_who_has_stopped_a_member_is_told_even_before_it_was_ready() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(wire.Ended(by="SIGTERM"))
        await settle()
        assert bench.heard() == [
            life.MachineLost(0, "gpu", "it was stopped there by SIGTERM", "SIGTERM")
        ]

    run(work)


def test_a_refusal_has_its_hint() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(wire.Refused("no\x1b such file", "copy it"))
        await settle()
        (event,) = bench.heard()
        assert isinstance(event, life.Refused)
        assert event.cause is Cause.MACHINE_REFUSES
        assert event.reason.startswith("machine gpu: no")
        assert event.reason.endswith("; hint: copy it")
        assert "\x1b" not in event.reason

    run(work)


def test_a_link_that_tries_again_is_no_reason() -> None:
    """A slow head sees the second attempt before the end of the first one."""

    async def work(bench: Bench) -> None:
        await bench.link()
        before = bench.roster.missing()
        await bench.link()
        assert bench.roster.missing() == before
        assert not is_news(f"waiting for {format_missing(before)}")

    run(work)


def test_a_second_link_replaces_the_first() -> None:
    async def work(bench: Bench) -> None:
        first = await bench.link()
        first.say(READY)
        await settle()
        second = await bench.link()
        assert first.writer.is_closed
        assert bench.heard()[1:] == [life.MachineLost(0, "gpu", "it has a new link")]
        second.say(READY)
        await settle()
        assert bench.heard()[2:] == [life.MachineJoined(0, "gpu")]

    run(work)


def test_a_machine_that_is_none_is_refused() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link("nobody")
        assert "has no node of this dataflow" in other.heard()[0]["error"]

    run(work)


def test_a_member_is_believed_for_its_own_nodes_only() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        killed = exit_of(-9)._replace(words=" (out of memory)")
        nodes = {name: NodeStatus("failed", 7, exit=killed) for name in ("mid", "here", "eye")}
        other.reader._limit = 1 << 18  # type: ignore[attr-defined]
        other.say(wire.Table(CellStatus(uuid=UUID, nodes=nodes).to_json()))
        await settle()
        own = NodeStatus("failed", 3, exit=exit_of(-9))
        table = CellStatus(
            nodes={
                "here": own,
                "mid": own._replace(pid=0, machine="gpu"),
                "eye": own._replace(pid=0, machine="cam"),
            }
        )
        shown = bench.roster.amend(table).nodes
        assert shown["mid"].exit == killed
        assert shown["mid"].pid == 0
        assert shown["here"] == own
        assert shown["eye"].exit == exit_of(-9)

    run(work)


def test_a_table_that_is_none_ends_the_talk() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY, wire.Table("{"))
        await settle()
        assert other.writer.is_closed
        lost = bench.heard()[-1]
        assert isinstance(lost, life.MachineLost)
        assert lost.is_failure, "else the head would start it for ever"

    run(work)


@pytest.mark.parametrize(
    ("word", "is_failure"),
    [
        (wire.Lost("Connection to gpu closed by remote host."), False),
        (wire.Ended("the machine is shutting down"), False),
        (wire.Ended("the dora coordinator is gone"), False),
        (wire.Lost(wire.RUNNER_ENDED), True),
        (wire.Ended("the dora daemon is gone (signal SIGKILL)", failed=1), True),
    ],
)
def test_a_machine_that_is_away_has_not_failed(word: wire.Message, is_failure: bool) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY, word)
        await settle()
        lost = bench.heard()[-1]
        assert isinstance(lost, life.MachineLost)
        assert lost.is_failure == is_failure

    run(work)


def test_another_run_has_other_ports_and_nothing_of_the_last_one() -> None:
    async def work(bench: Bench) -> None:
        bench.roster.set_token("secret")
        first = await bench.link()
        first.say(READY)
        await settle()
        bench.roster.close()
        late = await bench.link("cam")
        assert "the run ends" in late.heard()[0]["error"]
        ports = wire.Forwards(62000, {"head": 62001, "gpu": 62002, "cam": 62003})
        bench.roster.begin_again(ports, frozenset({"gpu"}))
        await settle()
        assert first.writer.is_closed
        assert [type(one) for one in bench.heard()] == [life.MachineJoined], "no new loss"
        assert bench.roster.works() == {"gpu": "", "cam": ""}
        again = await bench.link()
        assert [one.get("coordinator") for one in again.heard()] == [62000], "and no old token"

    run(work)


@pytest.mark.parametrize(
    ("word", "is_believed"),
    [
        (wire.Hung("mid", "no sign of life for 5s", "node-watchdog"), True),
        (wire.Hung("eye", "no sign of life for 5s", "node-watchdog"), False),
        (wire.Hung("here", "no sign of life for 5s", "node-hung"), False),
        (wire.Hung("mid", "no sign of life for 5s", "dataflow-failed"), False),
    ],
)
def test_why_a_member_ends_a_node(word: wire.Hung, is_believed: bool) -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY, word)
        await settle()
        told = [life.NodeHung(0, word.node, word.reason, word.record)] if is_believed else []
        assert bench.heard()[1:] == told

    run(work)


def test_a_late_report_is_not_about_the_next_process() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        bench.roster.pids["mid"] = 8
        words = ("mid", "no sign of life for 5s", "node-watchdog")
        other.say(READY, wire.Hung(*words, 7), wire.Hung(*words, 8), wire.Hung(*words))
        await settle()
        late = [one.is_late for one in bench.heard() if isinstance(one, life.NodeHung)]
        assert late == [True, False, False]

    run(work)


def test_the_time_left_of_a_node_there_is_shown_by_the_clock_here() -> None:
    """A member can send any number, and `list` must read the table of the head."""
    there = CellStatus(stop_dues={"mid": 3, "flood": 2**63 - 1})
    now = monotonic_us()
    shown = with_dues(there)
    assert [*shown.stop_dues] == ["mid"]
    assert 0 <= shown.stop_dues["mid"] - now - 3 < 10_000_000
    assert CellStatus.from_json(shown.to_json()) == shown


def test_a_part_that_waits_for_its_turn_is_still_there() -> None:
    async def work(bench: Bench) -> None:
        other = await bench.link()
        other.say(READY, wire.Ended("", "root", waits=1))
        await settle()
        words = "it was stopped there by root"
        lost = life.MachineLost(0, "gpu", words, "root", is_waiting=True)
        assert bench.heard() == [life.MachineJoined(0, "gpu"), lost]
        bench.roster.tell(wire.StopNode("mid", 1, 2), "gpu")
        bench.roster.tell(wire.StopNode("eye", 1, 2), "cam")
        assert [one["node"] for one in other.heard() if one["type"] == "stop-node"] == ["mid"]

    run(work)
