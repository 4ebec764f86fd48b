"""A stop while nodes wait at their gate: their launchers end once dora has stopped the others."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.status import STOP, NodeStatus
from dora_systemd.decisions.life import events as life
from dora_systemd.decisions.life.states import Do
from dora_systemd.runner.cell.pump import Pump
from tests.unit.fakes.dialogue import Bench, Heard
from tests.unit.fakes.loop import live, settle

WAITS = NodeStatus("waiting", 9, needs="/dev/video0 (not there)")
HELD = NodeStatus("stopped", 9, asked=STOP)
RUNS = NodeStatus("running", 7)


class Living(Heard):
    """A pump that also takes the events through the table."""

    def push(self, event: life.Event) -> None:
        super().push(event)
        Pump.push(self, event)


@contextmanager
def gate_of(bench: Bench, node: str) -> Iterator[int]:
    """What a launcher has open that waits there."""
    gate = bench.paths.node_gate(node)
    gate.parent.mkdir(exist_ok=True)
    bench.nodes.gates.make([node])
    fd = os.open(gate, os.O_RDONLY | os.O_NONBLOCK)
    yield fd
    os.close(fd)


def stopping(root: Path, **nodes: NodeStatus) -> Bench:
    bench = Bench(root, kind=Living)
    bench.pump.cell = replace(bench.pump.cell, nodes=nodes)
    bench.pump.connect(bench.actions)
    bench.dora.answers["Stop"].append({})
    return bench


@pytest.mark.parametrize("camera", [WAITS, HELD])
def test_a_waiting_launcher_ends_after_the_first_node(tmp_path: Path, camera: NodeStatus) -> None:
    """Before that, its end would be a failure, for dora."""

    async def work() -> None:
        bench = stopping(tmp_path, a=RUNS, camera=camera)
        with gate_of(bench, "camera") as gate:
            bench.actions[Do.ASK_STOP]()
            await settle()
            assert os.read(gate, 10) == b""
            bench.pump.push(life.NodeExited(1, "a", exit_of(0), False))
            await settle()
            assert os.read(gate, 3) == b"e00"
        assert not [one for one in bench.heard if isinstance(one, life.Failed)]

    live(work)


def test_it_does_not_wait_for_a_node_that_does_not_end(tmp_path: Path) -> None:
    async def work() -> None:
        bench = stopping(tmp_path, a=RUNS, camera=WAITS)
        with gate_of(bench, "camera") as gate:
            bench.actions[Do.ASK_STOP]()
            await asyncio.sleep(0.9)
            assert os.read(gate, 10) == b""
            await asyncio.sleep(0.2)
            assert os.read(gate, 3) == b"e00"

    live(work)


def test_where_no_node_waits_there_is_none_to_end(tmp_path: Path) -> None:
    async def work() -> None:
        bench = stopping(tmp_path, a=RUNS, camera=RUNS)
        with gate_of(bench, "camera") as gate:
            await bench.do(Do.ASK_STOP)
            await asyncio.sleep(2)
            assert os.read(gate, 10) == b""

    live(work)


def test_all_launchers_end_with_the_daemon(tmp_path: Path) -> None:
    async def work() -> None:
        bench = stopping(tmp_path, a=RUNS)
        with gate_of(bench, "camera") as gate:
            await bench.do(Do.DISMISS_DAEMON)
            assert os.read(gate, 3) == b"e00"

    live(work)
