"""Formats one snapshot for `doractl top`. Pure: no clock, no terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.status import ALIVE_NODE_STATES
from dora_systemd.decisions.resources.usage import WHOLE_CELL, format_waits
from dora_systemd.decisions.views.dataflows import format_table, node_count
from dora_systemd.decisions.views.facts import NodeRow, stopping_words
from dora_systemd.decisions.views.formats import (
    UNKNOWN,
    format_count,
    format_memory,
    format_percent,
    format_uptime,
)
from dora_systemd.decisions.views.objects import Shares, dataflow_object, moment
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.terminal_text import cut
from dora_systemd.values import counted

SORTS = ("cpu", "memory", "name")
HEADER = ("NAME", "STATE", "UPTIME", "CPU%", "MEM", "PEAK", "RESTARTS", "WAITS FOR")
NOTHING = "No dataflow is running."
_MOST_WORDS = 40
"""Characters of a node's own STATUS=."""


@dataclass(frozen=True)
class TopEntry:
    """A dataflow with its nodes."""

    row: DataflowRow
    # by node, WHOLE_CELL is the whole dataflow
    waits: Mapping[str, Shares] = field(default_factory=dict)


@dataclass(frozen=True)
class Look:
    """The content of one screen."""

    at_us: int  # CLOCK_REALTIME
    entries: Sequence[TopEntry] = ()


class TopRow(NamedTuple):
    """One line of the table: a dataflow, or one of its nodes."""

    uuid: str
    name: str
    node: str  # "" is the whole dataflow
    state: str  # the word that a colour stands for
    cells: Sequence[str]  # texts in the order of HEADER

    @property
    def key(self) -> tuple[str, str]:
        """The identity of the row, which does not change between readings."""
        return self.uuid, self.node


def sort_entries(entries: Sequence[TopEntry], by: str, is_reversed: bool = False) -> list[TopEntry]:
    """Entries by one of SORTS: highest usage first, or by name."""
    named = sorted(entries, key=lambda entry: entry.row.name)
    if by != "name":
        named.sort(key=lambda entry: -_amount(entry.row, by))
    return named[::-1] if is_reversed else named


def _amount(row: DataflowRow | NodeRow, by: str) -> float:
    return (row.cpu_percent if by == "cpu" else row.memory) or 0.0


def top_rows(look: Look, by: str, is_reversed: bool = False) -> list[TopRow]:
    """A row for each dataflow, followed by a row for each of its nodes."""
    entries = sort_entries(look.entries, by, is_reversed)
    return [row for one in entries for row in _rows(one, look, by, is_reversed)]


def format_top(look: Look, by: str, width: int | None = None, want_colors: bool = False) -> str:
    """The whole table, for a pipe, or for a terminal of that width."""
    cells = [row.cells for row in top_rows(look, by)]
    return format_table(HEADER, cells, width, want_colors) if cells else NOTHING


def _rows(entry: TopEntry, look: Look, by: str, is_reversed: bool) -> list[TopRow]:
    row = entry.row
    nodes = (
        list(row.nodes) if by == "name" else sorted(row.nodes, key=lambda one: -_amount(one, by))
    )
    stops = stopping_words(row.nodes)
    state = f"{row.status} {f'({stops})' if stops else node_count(row)}".rstrip()
    first = (row.name, state, format_uptime(row.uptime), *_numbers(row, entry.waits, WHOLE_CELL))
    return [
        TopRow(row.uuid, row.name, "", row.status, first),
        *(_node_row(node, entry, look) for node in (nodes[::-1] if is_reversed else nodes)),
    ]


def _node_row(node: NodeRow, entry: TopEntry, look: Look) -> TopRow:
    is_alive = node.state in ALIVE_NODE_STATES and node.since
    uptime = format_uptime(max(look.at_us - node.since, 0)) if is_alive else UNKNOWN
    word = node.word
    words = node.silent or (cut(node.text, _MOST_WORDS) if is_alive else node.exit)
    words = "; ".join(filter(None, (words, _outside(node))))
    state = f"{word} ({words})" if words else word
    place = f" on {node.machine}" if node.machine else ""
    cells = (f"  {node.node}{place}", state, uptime, *_numbers(node, entry.waits, node.node))
    whole = entry.row
    return TopRow(whole.uuid, whole.name, node.node, word, cells)


def _outside(node: NodeRow) -> str:
    """Format "outside: podman policy 9.1G": containers, which are in no other number of the row."""
    parts = (
        " ".join((*filter(None, one.labels.values()), format_memory(one.memory)))
        for one in node.containers
        if not one.is_inside
    )
    found = ", ".join(parts)
    return found and f"outside: {found}"


def _numbers(
    row: DataflowRow | NodeRow, waits: Mapping[str, Shares], key: str
) -> tuple[str, str, str, str, str]:
    shares = dict(waits.get(key, {}))
    if row.throttled:
        shares["cpu limit"] = row.throttled
    return (
        format_percent(row.cpu_percent, row.cpu_limit),
        format_memory(row.memory, row.memory_limit),
        format_memory(row.memory_peak),
        format_count(row.restarts),
        format_waits(shares),
    )


def format_summary(look: Look) -> str:
    """Number of dataflows and their total usage, in one line."""
    rows = [entry.row for entry in look.entries]
    nodes = sum(row.nodes_alive for row in rows)
    cpu = sum(row.cpu_percent or 0.0 for row in rows)
    memory = sum(row.memory or 0 for row in rows)
    return (
        f"{counted(len(rows), 'dataflow')}, {counted(nodes, 'node')}, "
        f"CPU {cpu:.1f}%, memory {format_memory(memory)}"
    )


def look_values(look: Look, by: str) -> dict[str, Any]:
    """The values for JSON: dataflows as in `doractl list`, with their waits."""
    entries = sort_entries(look.entries, by)
    return {
        **moment("at", look.at_us),
        "dataflows": [dataflow_object(one.row, one.waits) for one in entries],
    }
