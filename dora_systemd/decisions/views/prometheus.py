"""Formats a snapshot of dataflows and nodes for Prometheus. Pure.

https://prometheus.io/docs/instrumenting/exposition_formats and .../docs/practices/naming
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.cell.status import NODE_STATES
from dora_systemd.decisions.resources.usage import WHOLE_CELL, Strain, Usage, limit_of
from dora_systemd.decisions.views.dataflows import FAILED, STOPPED, UP_WORDS
from dora_systemd.decisions.views.facts import (
    NODE_FACTS,
    UNKNOWN_STATE,
    Labels,
    NodeRow,
    Sample,
    node_labels,
    node_samples,
)
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.decisions.views.snapshot import Observed
from dora_systemd.values import SECOND

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

STATES = tuple(sorted(word.lower() for word in (*UP_WORDS, STOPPED, FAILED)))


@dataclass(frozen=True)
class Family:
    """One metric."""

    name: str
    help: str
    # of one group, None if it has none; nodes elsewhere have no Strain here
    value: Callable[[Usage, Strain | None], float | int | None] = lambda _use, _strain: None

    @property
    def kind(self) -> str:
        """The type that Prometheus expects of a metric with this name."""
        return "counter" if self.name.endswith("_total") else "gauge"


# For dataflows (dora_dataflow_...) and for nodes (dora_node_...).
GROUP_FAMILIES = (
    Family("cpu_seconds_total", "CPU time used.", lambda use, _: use.cpu_us / SECOND),
    Family("cpu_limit_cores", "CPU limit, in cores.", lambda use, _: _cores(use)),
    Family(
        "cpu_periods_total",
        "CPU quota periods in which it was runnable.",
        lambda use, _: use.throttling[0],
    ),
    Family(
        "cpu_throttled_periods_total",
        "CPU quota periods in which its CPU limit throttled it.",
        lambda use, _: use.throttling[1],
    ),
    Family(
        "cpu_throttled_seconds_total",
        "Time for which its CPU limit throttled it.",
        lambda _, strain: strain and strain.throttled / SECOND,
    ),
    Family("memory_bytes", "Memory used.", lambda use, _: use.memory),
    Family(
        "memory_peak_bytes", "Peak memory used since its start.", lambda use, _: use.memory_peak
    ),
    Family("memory_limit_bytes", "Memory limit.", lambda use, _: limit_of(use.memory_max)),
    Family(
        "oom_kills_total",
        "Processes killed by the kernel, out of memory.",
        lambda _, strain: strain and strain.oom_kills,
    ),
)
PRESSURE = Family(
    "pressure_seconds_total", "Time in which some, or all, of its processes waited for a resource."
)
STATE = Family("state", "1 for the current state, 0 for all others.")
RESTARTS = Family("restarts_total", "Automatic restarts; those that somebody asked for are none.")
READY = Family("ready_time_seconds", "When all nodes were ready, in Unix time.")
INFO = Family("info", "UUID, unit, release and version of dora-systemd; the value is always 1.")
RIGHTS = Family("info", "What it is, its scheduling and CPUs; the value is always 1.")
FACT_FAMILIES = [(one, Family(one.metric, one.help)) for one in NODE_FACTS if one.metric]
NODES = Family("nodes", "Nodes that the dataflow has.")
ALIVE = Family("nodes_alive", "Nodes that are running.")
LINES = Family("log_lines_total", "Lines sent to journald.")
SUPPRESSED = Family(
    "log_lines_suppressed_total", "Lines that log_rate_limit kept out of the journal."
)
LOST = Family("log_lines_lost_total", "Lines of its nodes that are not in the journal.")
BUNDLES = Family("bundles", "Bundles of its failures that are kept.")
REFUSED = Family("bundles_refused_total", "Failures without a bundle: see bundle-refused.")
BUILD = Family("dora_systemd_build_info", "Version of dora-systemd; always 1.")


def format_metrics(observed: Sequence[Observed], version: str) -> str:
    """Format all metrics of these dataflows."""
    lines = list(_format(BUILD, "", [({"version": version}, 1)]))
    for prefix, families in (
        ("dora_dataflow_", _dataflow_samples(observed)),
        ("dora_node_", _node_samples(observed)),
    ):
        for family, samples in families:
            lines += _format(family, prefix, samples)
    return "".join(f"{line}\n" for line in lines)


def _dataflow_samples(observed: Sequence[Observed]) -> Iterator[tuple[Family, list[Sample]]]:
    labelled = [({"dataflow": one.row.name}, one) for one in observed]
    yield INFO, [({**own, **_identity(one.row)}, 1) for own, one in labelled]
    yield STATE, [s for own, o in labelled for s in _states(own, o.row.status.lower(), STATES)]
    yield RESTARTS, [(own, one.unit_restarts) for own, one in labelled]
    yield READY, [(own, o.row.ready / SECOND) for own, o in labelled if o.row.ready]
    yield NODES, [(own, one.row.nodes_total) for own, one in labelled if one.usage]
    yield ALIVE, [(own, one.row.nodes_alive) for own, one in labelled if one.usage]
    yield LOST, [(own, o.lines[WHOLE_CELL].lost) for own, o in labelled if WHOLE_CELL in o.lines]
    boxes = [(own, one.row.bundles) for own, one in labelled if one.row.bundles]
    yield BUNDLES, [(own, box.kept) for own, box in boxes]
    yield REFUSED, [(own, box.refused) for own, box in boxes]
    yield from _group_samples([(own, one, WHOLE_CELL) for own, one in labelled])


def _identity(row: DataflowRow) -> Labels:
    release = {"release": row.release} if row.release else {}
    version = {"version": row.runner_version} if row.runner_version else {}
    return {"uuid": row.uuid, "unit": row.unit, **release, **version}


def _node_samples(observed: Sequence[Observed]) -> Iterator[tuple[Family, list[Sample]]]:
    places = [
        ({"dataflow": one.row.name, "node": node.node, **_place(node)}, one, node)
        for one in observed
        for node in one.row.nodes
    ]
    yield RIGHTS, [({**own, **more}, 1) for own, _, n in places if (more := node_labels(n))]
    states = (*NODE_STATES, UNKNOWN_STATE)
    yield STATE, [sample for own, _, node in places for sample in _states(own, node.state, states)]
    restarts = [(own, node.restarts) for own, _, node in places]
    yield RESTARTS, [(own, count) for own, count in restarts if count is not None]
    for fact, family in FACT_FAMILIES:
        found = [(own, node_samples(fact, node)) for own, _, node in places]
        samples: list[Sample] = [({**own, **more}, v) for own, some in found for more, v in some]
        yield family, samples
    counts = [(own, o.lines[node.node]) for own, o, node in places if node.node in o.lines]
    yield LINES, [(own, count.written) for own, count in counts]
    yield SUPPRESSED, [(own, count.suppressed) for own, count in counts]
    yield from _group_samples([(own, one, node.node) for own, one, node in places])


def _place(node: NodeRow) -> Labels:
    """Return the label of the node's machine, if that is another one."""
    return {"machine": node.machine} if node.machine else {}


def _states(own: Labels, state: str, states: Iterable[str]) -> Iterator[Sample]:
    for one in states:
        yield {**own, "state": one}, int(one == state)


def _group_samples(
    places: Sequence[tuple[Labels, Observed, str]],
) -> Iterator[tuple[Family, list[Sample]]]:
    groups = [
        (own, one.usage[key], one.strains.get(key)) for own, one, key in places if key in one.usage
    ]
    for family in GROUP_FAMILIES:
        values = [(own, family.value(use, strain)) for own, use, strain in groups]
        yield family, [(own, value) for own, value in values if value is not None]
    strains = [(own, strain) for own, _, strain in groups if strain]
    yield PRESSURE, [sample for own, strain in strains for sample in _pressure(own, strain)]


def _pressure(own: Labels, strain: Strain) -> Iterator[Sample]:
    for resource, stalls in strain.stalled.items():
        for kind, stall in zip(("some", "full"), stalls, strict=True):
            yield {**own, "resource": resource, "kind": kind}, stall / SECOND


def _cores(use: Usage) -> float | None:
    share = limit_of(use.cpu_max)
    return None if share is None else share / SECOND


def _format(family: Family, prefix: str, samples: Iterable[Sample]) -> Iterator[str]:
    """The lines of one metric; no lines without a sample."""
    name = f"{prefix}{family.name}"
    lines = [f"{name}{{{_format_labels(labels)}}} {value}" for labels, value in samples]
    if lines:
        yield f"# HELP {name} {family.help}"
        yield f"# TYPE {name} {family.kind}"
        yield from lines


def _format_labels(labels: Labels) -> str:
    return ",".join(f'{key}="{_escaped(value)}"' for key, value in labels.items())


def _escaped(text: str) -> str:
    """Escape backslash, quote and newline as the format requires."""
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
