"""A stop with an order over several machines: nodes of each machine stop in their turn and time."""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import NAME, PLACE, Flow, flow_on
from tests.machines.journals import announced, killed, lost
from tests.machines.wires import clear, power_cut, there
from tests.system.cells import Project, run, wait_for
from tests.system.recorders import RECORDER, SOURCE, is_overtaken

SAVED = "/var/tmp/saved"
CONFIG = "/etc/dora-systemd/config.yml"
GRACE = 2
SLOW = 3 * GRACE
"""Seconds that the recorder needs for its file: dora would kill it after 1.5 times GRACE."""
DATAFLOW = """
nodes:
  - {{id: camera, path: source.py, inputs: {{t: dora/timer/millis/20}}, outputs: [out], {camera}}}
  - {{id: arm, path: source.py, inputs: {{t: dora/timer/millis/20}}, outputs: [out], {arm}}}
  - id: recorder
    path: recorder.py
    inputs:
      camera: {{source: camera/out, queue_size: 1000}}
      arm: {{source: arm/out, queue_size: 1000}}
      tick: dora/timer/millis/100
    {recorder}
"""
THERE, HERE = "deploy: {machine: gpu}", "deploy: {}"


@dataclass(frozen=True)
class Stops(Flow):
    """Cameras and a recorder. there: the nodes on b. stop: of the recorder."""

    there: tuple[str, ...] = ("camera",)
    stop: str = "{within: 60s, after: [camera, arm]}"
    seconds: int = SLOW
    extends: bool = False
    limit: str = ""
    begun: list[float] = field(default_factory=list)

    def write(self) -> None:
        self.begun[:] = [time.time()]
        place = Project(Path(PLACE), is_new=False)
        place.write("source.py", SOURCE)
        place.write("recorder.py", RECORDER)
        place.write("seconds", str(self.seconds))
        Path(PLACE, "extend").unlink(missing_ok=True)
        if self.extends:
            place.write("extend", "")
        where = {one: THERE if one in self.there else HERE for one in ("camera", "arm", "recorder")}
        place.write("dataflow.yml", DATAFLOW.format(**where))
        head = f"grace_duration: {GRACE}s\nsandbox: none\nenv: {{SAVED: {SAVED}}}\n{self.limit}"
        settings = f"{head}nodes:\n  recorder: {{stop: {json.dumps(self.stop)}}}\n"
        place.write("dataflow.systemd.yml", settings.replace('"', ""))
        for machine in self.machines:
            there(machine, f"rm -rf {SAVED}; mkdir -p {SAVED}; chmod 777 {SAVED}")

    def of(self, node: str) -> str:
        """The machine of a node."""
        return "b" if node in self.there else "a"

    def lines(self, node: str) -> list[str]:
        """What a node has printed in this test, on its machine."""
        words = ("journalctl", "-q", "-o", "cat", "-t", f"{NAME}/{node}", "--since")
        return there(self.of(node), *words, f"@{self.begun[0]:.0f}").stdout.splitlines()

    def wait_records(self, times: int = 1) -> None:
        """Wait until the recorder has received much of all sources, that often."""
        wait_for("it records", lambda: self.lines("recorder").count("records") >= times, 60)

    @contextmanager
    def held(self) -> Iterator[None]:
        """The recorder goes on with its file until the end of the block."""
        there(self.of("recorder"), "touch", f"{SAVED}/hold")
        try:
            yield
        finally:
            there(self.of("recorder"), "rm", f"{SAVED}/hold")

    def ends(self, node: str) -> list[tuple[int, int]]:
        """When a source ended each time, and how much it had sent."""
        lines = (one.split() for one in self.lines(node))
        return [(int(line[1]), int(line[2])) for line in lines if line[:1] == ["ends"]]

    def episodes(self) -> list[dict[str, Any]]:
        """What the recorder has saved, without a file that is not complete."""
        command = f"'cd {SAVED} && for one in $(ls | grep json); do cat $one; echo; done'"
        found = there(self.of("recorder"), "sh", "-c", command).stdout
        return [json.loads(one) for one in found.splitlines()]

    def check_whole(self, times: int, sources: tuple[str, ...] = ("camera", "arm")) -> None:
        """Each file has the last that the sources have sent, and they ended before its stop."""
        wait_for("the file is complete", lambda: len(self.episodes()) >= times, 60)
        episodes = self.episodes()
        assert len(episodes) == times
        for node in sources:
            for episode, (at, sent) in zip(episodes, self.ends(node), strict=True):
                assert episode[node] == sent or is_overtaken(episode, node, sent)
                assert at <= episode["told"], node


BOTH = pytest.mark.parametrize(
    "flow",
    [Stops({"gpu": "b"}), Stops({"gpu": "b"}, ("recorder",))],
    ids=["recorder on the head", "recorder on the member"],
)


@BOTH
def test_the_order_holds_across_machines(flow: Stops, request: pytest.FixtureRequest) -> None:
    """At a stop, a restart, and what systemd does on the head."""
    with flow_on(flow, announced(request)):
        flow.start()
        flow.wait_records()
        row = flow.row
        flow.cell.doractl("restart", NAME)
        flow.check_whole(1)
        flow.wait_records(2)
        run("systemctl", "restart", f"dora-{NAME}")
        flow.check_whole(2)
        flow.wait_records(3)
        with flow.held():
            stop = run_beside(lambda: flow.cell.doractl("stop", NAME))
            wait_for("list has its status", lambda: _is_shown(row))
        assert stop().returncode == 0
        flow.check_whole(3)
        assert not flow.left()


def _is_shown(row: Callable[[], Mapping[str, Any]]) -> bool:
    (node,) = (one for one in row()["nodes"] if one["node"] == "recorder")
    print(node["state"], node["pid"], node["text"], node["stop_left_us"])  # if it never is
    return node["text"] == "writing episode" and 0 < (node["stop_left_us"] or 0) < 60e6


def run_beside(work: Callable[[], Any]) -> Callable[[], Any]:
    """Begin `work` in a thread; the function waits for its result."""
    pool = ThreadPoolExecutor(1)
    future = pool.submit(work)
    return lambda: future.result()


@BOTH
@pytest.mark.warns("flow failed: it was stopped on machine gpu by ", "gpu of dataflow flow")
@pytest.mark.warns("systemd: dora-flow.service: Failed with result 'exit-code'", "code=exited")
def test_a_part_that_systemd_stops(flow: Stops, request: pytest.FixtureRequest) -> None:
    """The member waits for its turn, and then the whole dataflow has stopped."""
    with flow_on(flow, announced(request)):
        flow.start()
        flow.wait_records()
        assert there("b", "systemctl", "stop", f"dora-{NAME}").returncode == 0
        flow.check_whole(1)
        wait_for("it has ended", lambda: flow.cell.show("ActiveState") == "failed")


def test_a_node_there_gets_more_time(request: pytest.FixtureRequest) -> None:
    flow = Stops({"gpu": "b"}, ("recorder",), "{within: 2s, after: [camera]}", extends=True)
    with flow_on(flow, announced(request)):
        flow.start()
        flow.wait_records()
        flow.cell.doractl("stop", NAME)
        flow.check_whole(1, ("camera",))


def test_a_machine_that_is_slow_for_some_seconds(request: pytest.FixtureRequest) -> None:
    """Its recorder gets its stop, and not the SIGTERM of a machine that is lost."""
    flow = Stops({"gpu": "b"}, ("recorder",), seconds=0)
    with flow_on(flow, announced(request)):
        flow.start()
        flow.wait_records()
        runner = flow.pid("b", "dora_systemd.runner")
        hang = f"kill -STOP {runner}; sleep 4; kill -CONT {runner}"
        hangs = run_beside(lambda: there("b", hang))
        flow.cell.doractl("stop", NAME)
        assert hangs().returncode == 0
        flow.check_whole(1)


@lost
@pytest.mark.warns("dora-flow", "Node ")
def test_a_machine_without_power_leaves_the_order_of_the_others(
    request: pytest.FixtureRequest,
) -> None:
    """The recorder completes its file after the arm has ended; the camera is gone."""
    flow = Stops({"gpu": "b"})
    with flow_on(flow, announced(request)):
        flow.start()
        flow.wait_records()
        with power_cut("b"):
            wait_for("it has ended", lambda: flow.cell.show("ActiveState") == "failed", 60)
            flow.check_whole(1, ("arm",))
        clear("b")


@lost
@killed
@pytest.mark.warns("SIGKILL", "dora-flow", "Node ", "recorder")
def test_a_node_that_is_stopping_keeps_its_time_without_the_head(
    request: pytest.FixtureRequest,
) -> None:
    flow = Stops({"gpu": "b"}, ("recorder",), seconds=2 * SLOW)
    with flow_on(flow, announced(request)):
        flow.start("--restart-policy=no")
        flow.wait_records()
        runner = flow.pid("a", "dora_systemd.runner")
        stop = run_beside(lambda: flow.cell.doractl("stop", NAME, check=False))
        wait_for("it writes", lambda: "part" in there("b", "ls", SAVED).stdout, 60)
        run("kill", "-KILL", runner)
        flow.check_whole(1)
        stop()


REFUSED = ("flow failed: machine gpu: cannot give the node", "dora-flow.service")


def test_what_is_refused() -> None:
    """One line before any node runs."""
    circle = Stops({"gpu": "b"}, stop="{after: [recorder]}")
    with flow_on(circle):
        circle.refused("cannot stop recorder after recorder", code=ExitCode.BAD_INPUT)
    # The limit of the member bounds the shutdown of its machine.
    flow = Stops({"gpu": "b"}, ("recorder",), "{within: 200s}")
    with flow_on(flow, REFUSED):
        there("b", f"mkdir -p /etc/dora-systemd; echo stop_limit: 100s > {CONFIG}")
        try:
            words = ("gpu", "cannot give the node recorder 3min 20s", "stop_limit is 1min 40s")
            flow.refused(*words, code=ExitCode.BAD_INPUT)
        finally:
            there("b", "rm", CONFIG)
