"""What the gateway does for others: the buttons of the page, and stop and restart of dora."""

import asyncio
import fcntl
import json
import os
import signal
import socket
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.cell.status import CellStatus, NodeStatus
from dora_systemd.decisions.gateway.frames import Request
from dora_systemd.decisions.gateway.page_messages import PageMessage
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.control.forward import forward
from dora_systemd.gateway.control.jobs import wanted_start
from dora_systemd.gateway.control.serve import HANDLERS
from dora_systemd.gateway.control.session import Talk
from dora_systemd.gateway.live.actions import Actions, act, read_graph
from dora_systemd.runner.cell.begin import make_lock
from dora_systemd.scope import Scope
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import FakeSystemd, fake_journalctl, fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options
from tests.unit.fakes.programs import make_dora, make_program
from tests.unit.fakes.runner import fake_runner
from tests.unit.fakes.socket import FakeSocket

UNIT = "dora-robot.service"
NOBODY = "11111111-2222-4333-8444-555555555555"


class Bench:
    """A gateway for the scope of this user, whose systemd has the dataflow robot."""

    def __init__(self, root: Path, patch: pytest.MonkeyPatch, active: str = "active") -> None:
        self.manager = FakeManager()
        self.units = root / "units"  # in the place of systemd's own, which only root may change
        runner = options(dataflow=str(root / "flow.yml"))
        self.manager.add(runner, active=active, FragmentPath=str(self.units / UNIT))
        self.systemd: FakeSystemd = fake_systemd(patch, self.manager)
        self.scope: Scope = ScopeIn(is_user=True, uid=os.getuid(), root=root)
        self.notes: list[bytes] = []
        patch.setattr(socket.socket, "sendto", lambda _, data, *__: self.notes.append(data))
        (root / "flow.yml").write_text("nodes: [{id: a, path: a.py}]\n")

    def act(self, action: str, dataflow: str = UUID, node: str = "", **values: str) -> str:
        return act(self.scope, PageMessage("act", dataflow, node, action, values=values))

    def change(self, action: str, node: str = "", **values: str) -> str:
        """The same with a systemd that knows all changes."""
        message = PageMessage("act", UUID, node, action, values=values)
        return act(self.scope, message, self.manager)

    def ask(self, variant: str, **body: Any) -> Any:
        talk = Talk(FakeSocket([]), self.scope)
        return asyncio.run(_answer(talk, Request("x", variant, body)))

    @property
    def jobs(self) -> list[str]:
        return [call[0] for call in self.manager.calls if call[0].endswith("Unit")]


async def _answer(talk: Talk, request: Request) -> Any:
    return await HANDLERS[request.name](talk, request)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def test_the_page_stops_a_dataflow_and_says_who_asked(bench: Bench) -> None:
    assert bench.act("stop") == f"Dataflow stopped: {UUID} (robot)"
    assert bench.manager.calls == [("StopUnit", UNIT)]
    (note,) = bench.notes
    assert b"stop-asked" in note
    assert b"(status page)" in note


@pytest.mark.parametrize(
    ("door", "notes"),
    [("page", ("(status page)", "(status page)")), ("dora", ("(dora stop)", "(dora stop robot)"))],
)
def test_who_has_stopped_what_ends_with_another_one(
    bench: Bench, door: str, notes: tuple[str, str]
) -> None:
    """The page and the dora command name who has asked for the end of those that need it, too."""
    for uuid, name in ((NOBODY, "arm"), (NOBODY.replace("1", "6"), "old")):
        bench.manager.add(options(name, uuid), active="active" if name == "arm" else "failed")
    bench.manager.units[UNIT]["RequiredBy"] = ["dora-arm.service", "dora-old.service"]
    if door == "page":
        ends = [one.partition(":")[0] for one in bench.act("stop").split("; ")]
        assert ends == ["Dataflow stopped"] * 2
        assert [call[1] for call in bench.manager.calls] == [UNIT, "dora-arm.service"]
    else:
        bench.ask("StopByName", name="robot", force=True)
    for name, by, note in zip(("robot", "arm"), notes, bench.notes, strict=True):
        assert f"DORA_DATAFLOW_NAME={name}\n".encode() in note
        assert by.encode() in note


def test_the_page_restarts_a_dataflow(bench: Bench) -> None:
    assert bench.act("restart") == f"Dataflow restarted: {UUID} (robot)"
    assert bench.jobs == ["RestartUnit"]
    assert b"(status page)" in bench.notes[0]


def test_a_restart_that_fails_is_told_with_where_to_look(bench: Bench) -> None:
    bench.manager.job_results[UNIT] = "failed"
    bench.manager.units[UNIT] |= {"StatusText": "failed: node a: exit code 3"}
    with pytest.raises(DoraSystemdError, match="node a: exit code 3") as caught:
        bench.act("restart")
    flag = bench.scope.flag
    check = f"check logs: doractl {flag} logs robot --node a"
    assert caught.value.hint == f"{check}; doractl {flag} why robot shows more"


def test_the_page_names_a_dataflow_that_is_gone(bench: Bench) -> None:
    with pytest.raises(DoraSystemdError, match="no dataflow named") as caught:
        bench.act("stop", NOBODY)
    assert caught.value.code is ExitCode.NOT_FOUND
    assert not bench.manager.calls


@pytest.mark.parametrize("action", ["stop", "restart"])
def test_a_node_of_a_dataflow_that_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action: str
) -> None:
    bench = Bench(tmp_path, monkeypatch, active="failed")
    with pytest.raises(DoraSystemdError, match="cannot use the dataflow robot: it is not running"):
        bench.act(action, node="a")
    assert not bench.manager.calls, "the dataflow is not stopped in place of its node"


def test_the_page_starts_what_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path, monkeypatch, active="failed")
    assert bench.act("start") == f"Dataflow restarted: {UUID} (robot)"
    assert bench.jobs == ["RestartUnit"]


def write_start(patch: pytest.MonkeyPatch, root: Path, flow: Path) -> None:
    """A journal with the start of the dataflow arm, which has ended."""
    record = {
        "_PID": "7",
        "_UID": str(os.getuid()),
        "DORA_EVENT": "start-asked",
        "DORA_SCOPE": "user",
        "DORA_SETTINGS": "{}",
        "DORA_DATAFLOW_NAME": "arm",
        "DORA_DATAFLOW": NOBODY,
        "DORA_FILE": str(flow),
    }
    FakeJournal(patch, root).write(record)


def test_a_start_of_what_has_ended_says_who_asked(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_start(monkeypatch, tmp_path, tmp_path / "flow.yml")
    make_dora(tmp_path / "bin" / "dora", "1.1.0")
    make_program(tmp_path / "a.py")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    message = PageMessage("act", NOBODY, action="start")
    assert act(bench.scope, message, bench.manager) == f"Dataflow restarted: {NOBODY} (arm)"
    (note,) = (one for one in bench.notes if b"start-asked" in one)
    assert b"(status page)" in note


def test_the_page_starts_what_has_ended(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flow = tmp_path / "gone.yml"
    write_start(monkeypatch, tmp_path, flow)
    with pytest.raises(DoraSystemdError, match=f"{flow}"):
        bench.act("start", NOBODY)
    with pytest.raises(DoraSystemdError, match="cannot enable arm: it has ended") as caught:
        bench.act("enable", NOBODY)
    assert caught.value.hint == "doractl start arm"
    with pytest.raises(DoraSystemdError, match="cannot restart node a: arm has ended"):
        bench.act("restart", NOBODY, node="a")


@pytest.mark.parametrize(
    ("action", "values", "problem"),
    [
        ("set", {}, "cannot change the limits of robot: none is given"),
        ("set", {"memory_limit": "much"}, "cannot read 'much' as a size"),
        ("set", {"nodes": "a:memory_limit=much"}, "cannot read 'much' as a size"),
        ("set", {"nodes": "nobody:memory_limit=2G"}, "cannot limit the node 'nobody'"),
        ("set", {"hot_reload": "on"}, "robot"),
        ("reload", {}, "robot"),
    ],
)
def test_what_the_verbs_refuse_the_page_refuses(
    bench: Bench, action: str, values: dict[str, str], problem: str
) -> None:
    with pytest.raises(DoraSystemdError, match=problem):
        bench.act(action, **values)
    # systemd reloads, but nothing has changed then.
    assert set(bench.manager.calls) <= {("reload",)}
    assert not [*bench.units.rglob("*.conf")]


def test_the_page_sets_limits(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mount = fake_cgroups(monkeypatch, tmp_path)
    (mount / "cgroup.controllers").write_text("memory")
    with fake_runner(bench.scope.cell_directory("robot")) as asked:
        done = bench.change("set", memory_limit="6G", hot_reload="off")
    assert done == f"Limits changed: {UUID} (robot); Hot reload off: {UUID} (robot)"
    changed, reloaded = bench.manager.calls
    assert changed == ("set", UNIT, [("MemoryMax", "t", 6 << 30)], False)
    assert reloaded == ("reload",)
    assert asked[-1] == {"verb": "hot-reload", "on": False}


def test_the_page_changes_nothing_if_a_part_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (fake_cgroups(monkeypatch, tmp_path) / "cgroup.controllers").write_text("memory")
    bench = Bench(tmp_path, monkeypatch, active="failed")
    with pytest.raises(DoraSystemdError, match="robot: it is not running"):
        bench.change("set", memory_limit="6G", hot_reload="off")
    assert bench.manager.calls == []


def test_the_page_reloads(bench: Bench) -> None:
    _run(bench, "run")
    with fake_runner(bench.scope.cell_directory("robot")) as asked:
        assert bench.change("reload") == "Nothing has changed"
        assert asked[-1] == {"verb": "reload", "node": None}
    with fake_runner(bench.scope.cell_directory("robot"), "a was restarted", "b was") as asked:
        assert bench.change("reload", node="a") == "a was restarted; b was"
        assert asked[-1] == {"verb": "reload", "node": "a"}


def test_the_page_enables_and_disables(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_program(tmp_path / "bin/loginctl", "exit 1")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    bench.scope = ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path / "run")
    bench.manager.etc = tmp_path / "etc"
    assert bench.change("disable") == f"Dataflow not enabled: {UUID} (robot)"
    enabled, path, linger = bench.change("enable").split("; ", 2)
    assert enabled == f"Dataflow enabled: {UUID} (robot)"
    assert Path(path).is_relative_to(tmp_path)
    assert "as root: loginctl enable-linger" in linger


def test_an_action_of_a_gateway_that_ends() -> None:
    told: list[int] = []
    actions = Actions(told.append)
    with actions.acting() as action:
        assert actions.is_acting
        action.go_on()
        actions.end()
        assert told == []
        with pytest.raises(DoraSystemdError, match="the gateway was stopped"):
            action.go_on()
        action.go_on()  # the way back is not stopped
    assert told == [30_000_000] * 2
    # A thread was at something else when the others were told: it begins nothing.
    with pytest.raises(DoraSystemdError, match="the gateway was stopped"), actions.acting():
        pytest.fail("it has begun")
    assert not actions.is_acting


def test_the_drawing_of_a_dataflow_that_has_no_coordinator(bench: Bench) -> None:
    assert read_graph(bench.scope, UUID)["nodes"] == [{"id": "a", "kind": "python"}]


def test_dora_starts_the_file_of_its_session(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "flow.dora-session.yaml").write_text("session_id: one\n")
    sent = {"nodes": [{"id": "a"}], "env": {"A": "b"}}
    body = {"dataflow": sent, "local_working_dir": str(tmp_path), "session_id": "one"}
    wanted = wanted_start(Request("x", "Start", {**body, "name": "robot", "uv": True}))
    assert (wanted.dataflow, wanted.name) == (str(tmp_path / "flow.yml"), "robot")
    assert wanted.flags == {"env": ("A=b",), "uv": True}
    with pytest.raises(DoraSystemdError, match="cannot find out which file this dataflow is from"):
        bench.ask("Start", **body | {"session_id": "two"})
    assert not bench.manager.calls


@pytest.mark.parametrize("name", ["Stop", "Restart"])
def test_nobody_is_stopped_for_another_uuid(bench: Bench, name: str) -> None:
    with pytest.raises(DoraSystemdError, match=f"^no dataflow with the UUID {NOBODY}$"):
        bench.ask(name, dataflow_uuid=NOBODY)
    assert not bench.manager.calls


def test_a_stop_of_what_has_ended_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, monkeypatch, active="failed")
    with pytest.raises(DoraSystemdError, match=r"^cannot stop robot: it does not run$") as caught:
        bench.ask("StopByName", name="robot")
    assert caught.value.code is ExitCode.NOT_RUNNING
    assert not bench.notes


def test_dora_stops_a_dataflow(bench: Bench) -> None:
    answer = bench.ask("Stop", dataflow_uuid=UUID, force=True)["DataflowStopped"]
    assert (answer["uuid"], answer["result"]["node_results"]) == (UUID, {})
    assert bench.jobs == ["StopUnit"]
    assert b"(dora stop)" in bench.notes[0]
    assert ("kill", UNIT, signal.SIGKILL, "all") not in bench.manager.calls


def test_a_stop_that_takes_too_long_ends_with_a_kill(bench: Bench) -> None:
    bench.systemd.is_slow = True
    bench.ask("StopByName", name="robot", force=True)
    assert bench.manager.calls[-1] == ("kill", UNIT, signal.SIGKILL, "all")


def test_the_next_life_of_a_unit_is_not_killed(bench: Bench) -> None:
    bench.systemd.is_slow = True

    def again() -> str:
        bench.systemd.finish()
        return "two"

    bench.systemd.lives = [lambda: "one", again]
    bench.ask("RestartByName", name="robot", grace_duration={"secs": 0, "nanos": 0})
    assert bench.jobs == ["RestartUnit"]
    assert not [call for call in bench.manager.calls if call[0] == "kill"]


def test_what_only_looks_does_not_wait_for_a_silent_bus(bench: Bench) -> None:
    for variant in ("List", "GetNodeInfo", "ConnectedMachines"):
        bench.ask(variant)
    for variant in ("Check", "WaitForSpawn"):
        bench.ask(variant, dataflow_uuid=UUID)
    assert len(bench.systemd.timeouts) >= 5
    assert {*bench.systemd.timeouts} == {"5s"}


def test_the_last_lines_come_before_the_reply_about_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeJournal(monkeypatch, tmp_path)
    bench = Bench(tmp_path, monkeypatch, active="failed")
    talk = Talk(FakeSocket([]), bench.scope)
    request = Request("x", "Check", {"dataflow_uuid": UUID})

    async def work() -> None:
        talk.followed[UUID] = asyncio.Event()
        reply = asyncio.ensure_future(_answer(talk, request))
        done, _ = await asyncio.wait({reply}, timeout=2)
        assert not done
        talk.followed[UUID].set()
        await asyncio.wait({reply}, timeout=20)
        assert reply.done()

    asyncio.run(work())


def test_a_dora_restart(bench: Bench) -> None:
    answer = bench.ask("Restart", dataflow_uuid=UUID)
    assert answer == {"DataflowRestarted": {"old_uuid": UUID, "new_uuid": UUID}}


def test_a_dora_restart_asks_for_locks(bench: Bench) -> None:
    lock = bench.scope.cell_directory("robot") / "inhibit.lock"
    lock.parent.mkdir(parents=True)
    make_lock(lock)
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        with pytest.raises(DoraSystemdError, match="cannot restart robot: inhibited by") as caught:
            bench.ask("RestartByName", name="robot", force=True)
    assert caught.value.code is ExitCode.INHIBITED
    assert "restart --wait robot" in caught.value.hint
    assert not bench.manager.calls
    assert not bench.notes
    bench.ask("Restart", dataflow_uuid=UUID)
    assert bench.jobs == ["RestartUnit"]


@pytest.mark.parametrize("door", ["Restart", "RestartByName", "page"])
def test_what_could_not_start_again_keeps_running(bench: Bench, door: str) -> None:
    """Also for the dora command and the page, which have no --force."""
    refused = {"error": "node a has no path", "hint": "did you mean 'path'?", "code": 6}
    with (
        fake_runner(bench.scope.cell_directory("robot"), refused=refused) as asked,
        pytest.raises(DoraSystemdError, match=r"^node a has no path$") as caught,
    ):
        if door == "page":
            bench.act("restart")
        else:
            bench.ask(door, dataflow_uuid=UUID, name="robot", force=True)
    assert {"verb": "check"} in asked
    assert caught.value.code == refused["code"]
    assert caught.value.hint == (
        "did you mean 'path'? robot keeps running; doractl restart --force robot restarts it anyway"
    )
    assert not bench.jobs
    assert not bench.notes, "nobody has asked for an end that has not come"


def test_a_dora_restart_that_fails(bench: Bench) -> None:
    bench.manager.job_results[UNIT] = "failed"
    bench.manager.units[UNIT] |= {"StatusText": "failed: x"}
    with pytest.raises(DoraSystemdError, match="cannot restart") as caught:
        bench.ask("RestartByName", name="robot")
    assert caught.value.hint == "doractl --user why robot shows more"


def _run(bench: Bench, run: str) -> None:
    directory = bench.scope.cell_directory("robot")
    directory.mkdir(parents=True)
    table = CellStatus(run=run, nodes={"a": NodeStatus("running")})
    (directory / "status.json").write_text(table.to_json())


def test_what_only_a_coordinator_knows_waits_for_a_run(bench: Bench) -> None:
    request = Request("x", "GetParams", {"dataflow_id": UUID, "node_id": "a"})
    _run(bench, "")
    with pytest.raises(DoraSystemdError, match="it is starting or stopping") as caught:
        asyncio.run(forward(Talk(FakeSocket([]), bench.scope), request))
    assert caught.value.code is ExitCode.NOT_RUNNING


def test_a_node_that_is_not_there_is_not_restarted(bench: Bench) -> None:
    _run(bench, "run")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(bench.scope.cell_directory("robot") / "runner.sock"))
        one.listen()
        with pytest.raises(DoraSystemdError, match="cannot find a node 'b'"):
            bench.ask("RestartNode", dataflow_id=UUID, node_id="b")


def entry(text: str, at_us: int, node: str = "a") -> bytes:
    fields = {
        "__REALTIME_TIMESTAMP": at_us,
        "__SEQNUM": 7,
        "DORA_NODE": node,
        "DORA_STREAM": "stdout",
        "MESSAGE": text,
    }
    return b"".join(f"{key}={value}\n".encode() for key, value in fields.items()) + b"\n"


def test_logs_begin_with_the_oldest_line(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = fake_journalctl(monkeypatch, tmp_path, entry("new", 2) + entry("old", 1))
    link = FakeSocket([])
    talk = Talk(link, bench.scope)
    request = Request("x", "Logs", {"uuid": UUID, "node": "a", "tail": 2})
    assert asyncio.run(_answer(talk, request)) is None, "it has answered by itself"
    lines = bytes(link.sent[0]["result"]["Logs"]).splitlines()
    assert [json.loads(line)["msg"] for line in lines] == ["old", "new"]
    assert talk.places == {UUID: {"a": (2, 7)}}, "what is followed goes on from there"
    arguments = calls.read_text().split()
    assert {"--lines=2", f"DORA_DATAFLOW={UUID}", "DORA_NODE=a"} <= {*arguments}


def test_logs_of_a_node_that_is_not_there(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_journalctl(monkeypatch, tmp_path, b"")
    _run(bench, "run")
    with pytest.raises(DoraSystemdError, match="cannot find a node 'b' of") as caught:
        bench.ask("Logs", uuid=UUID, node="b")
    assert caught.value.hint == "nodes: a"
