"""The live table of one cell: what its runner writes to status.json and what `list` reads there."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd.errors import DoraSystemdError, ExitCode

STAGES = ("restarting", "starting", "waiting", "running", "degraded", "stopping", "ended")
NODE_STATES = (
    "starting",
    "ready",
    "running",
    "restarting",
    "reloading",
    "finished",
    "failed",
    "stopped",
    "dynamic",
)
HELD = "held"
"""Policy of a node that, when it has failed, waits for a reload."""
ALIVE_NODE_STATES = frozenset({"ready", "running", "dynamic"})
WHOLE_CELL = ""
"""The key of a CPU sample that stands for the unit's whole cgroup."""
SAMPLES_KEPT = 2
SHORTEST_WINDOW_US = 1_000_000


class NodeStatus(NamedTuple):
    """One node as the runner sees it.

    state: one of NODE_STATES. pid: 0 when no process is known. restarts: how often dora restarted
    it in this run. since_us: CLOCK_REALTIME µs of the last change of state. exit: how its last
    process ended, "" or a text such as "exit code 1" or "signal SIGKILL". kind: how dora
    starts it (python, executable, shell, uv, operator, ros2, dynamic, url). policy: dora's word
    for what it restarts, "never" where it says none, or HELD. max_restarts: how often in one
    window, 0 without limit. hung: what dora's health check said of the process before it ended it,
    or "".
    """

    state: str = "starting"
    pid: int = 0
    restarts: int = 0
    since_us: int = 0
    exit: str = ""
    kind: str = ""
    policy: str = "never"
    max_restarts: int = 0
    hung: str = ""

    @property
    def is_alive(self) -> bool:
        """Whether it counts as one of the "2/3 nodes" that are there."""
        return self.state in ALIVE_NODE_STATES


class CpuSample(NamedTuple):
    """CPU time used up to the moment `at_us` (CLOCK_MONOTONIC µs), in µs, by node id.

    throttling: periods in which the node wanted to run and in which it had to wait for its limit.
    The key WHOLE_CELL is the unit's whole cgroup.
    """

    at_us: int
    cpu_us: Mapping[str, int] = {}
    throttling: Mapping[str, tuple[int, int]] = {}


class LineCount(NamedTuple):
    """Lines that journald was given, that a limit took away, and that are lost, since the start."""

    written: int = 0
    suppressed: int = 0
    lost: int = 0


class CellStatus(NamedTuple):
    """What status.json holds.

    run: dora's own id of this run, or "". stage: one of STAGES. text: the unit's STATUS=.
    started_us, ready_us: CLOCK_REALTIME µs, 0 when that has not happened.
    samples: the last SAMPLES_KEPT CPU samples, oldest first. lines: by node, and the lost ones of
    WHOLE_CELL.
    """

    uuid: str = ""
    run: str = ""
    stage: str = "starting"
    text: str = ""
    started_us: int = 0
    ready_us: int = 0
    nodes: Mapping[str, NodeStatus] = {}
    samples: tuple[CpuSample, ...] = ()
    lines: Mapping[str, LineCount] = {}

    @property
    def alive_count(self) -> int:
        """How many nodes are there, dynamic ones included."""
        return sum(node.is_alive for node in self.nodes.values())

    @property
    def node_restarts(self) -> int:
        """Restarts of all nodes in this run, by dora."""
        return sum(node.restarts for node in self.nodes.values())

    def to_json(self) -> str:
        """The text of status.json."""
        values = self._asdict()
        values["nodes"] = {key: node._asdict() for key, node in self.nodes.items()}
        values["samples"] = [
            {**one._asdict(), "cpu_us": {**one.cpu_us}, "throttling": {**one.throttling}}
            for one in self.samples
        ]
        values["lines"] = {**self.lines}
        return json.dumps(values)

    @classmethod
    def from_json(cls, text: str) -> "CellStatus":
        """Inverse of to_json. Unknown keys are left aside: the runner may be a newer version.

        Raises DoraSystemdError when the text is not such a table at all.
        """
        try:
            return _parse_cell(json.loads(text))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise DoraSystemdError(
                f"cannot read the node table of a dataflow: {error}",
                "it was written by another version of dora-systemd, or damaged",
                ExitCode.FAILURE,
            ) from error


def add_sample(samples: tuple[CpuSample, ...], sample: CpuSample) -> tuple[CpuSample, ...]:
    """`samples` with a newer one, the oldest dropped."""
    return (*samples, sample)[-SAMPLES_KEPT:]


def cpu_percent(samples: tuple[CpuSample, ...], now: CpuSample, key: str = WHOLE_CELL) -> float:
    """CPU use of `key` up to `now` in percent of one processor, as top(1) counts.

    The window begins at the newest sample that is at least a second old. A key that a sample lacks
    had used nothing then; a count that went down belongs to a new group.
    """
    base = _window_start(samples, now)
    window = now.at_us - base.at_us
    used = now.cpu_us.get(key, 0) - base.cpu_us.get(key, 0)
    return max(100.0 * used / window, 0.0) if window > 0 else 0.0


def throttled_percent(
    samples: tuple[CpuSample, ...], now: CpuSample, key: str = WHOLE_CELL
) -> float:
    """Of the time in which `key` wanted to run, the share in which its CPU limit made it wait.

    The window is that of cpu_percent.
    """
    old_periods, old_throttled = _window_start(samples, now).throttling.get(key, (0, 0))
    periods, throttled = now.throttling.get(key, (0, 0))
    wanted = periods - old_periods
    return 100.0 * (throttled - old_throttled) / wanted if wanted > 0 else 0.0


def _window_start(samples: tuple[CpuSample, ...], now: CpuSample) -> CpuSample:
    old_enough = [s for s in samples if now.at_us - s.at_us >= SHORTEST_WINDOW_US]
    return old_enough[-1] if old_enough else next(iter(samples), CpuSample(0))


def _parse_cell(raw: Any) -> CellStatus:
    known = _known(CellStatus, raw)
    nodes = {
        str(key): NodeStatus(**_known(NodeStatus, node))
        for key, node in known.pop("nodes", {}).items()
    }
    samples = tuple(_parse_sample(one) for one in known.pop("samples", ()))
    lines = {str(key): LineCount(*map(int, one)) for key, one in known.pop("lines", {}).items()}
    return CellStatus(**known, nodes=nodes, samples=samples, lines=lines)


def _parse_sample(raw: Any) -> CpuSample:
    usage = {str(key): int(value) for key, value in raw.get("cpu_us", {}).items()}
    throttling = {
        str(key): (int(one), int(two)) for key, (one, two) in raw.get("throttling", {}).items()
    }
    return CpuSample(int(raw["at_us"]), usage, throttling)


def _known(kind: type[Any], raw: Any) -> dict[str, Any]:
    defaults = kind._field_defaults
    return {
        key: type(defaults[key])(value) if isinstance(defaults[key], int | str) else value
        for key, value in raw.items()
        if key in defaults
    }
