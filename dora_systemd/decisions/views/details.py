"""Formats one dataflow and its nodes for `doractl list SELECTOR`."""

from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.cell.restarts import budget_words
from dora_systemd.decisions.cell.status import format_stopped
from dora_systemd.decisions.resources.containers import format_outside
from dora_systemd.decisions.views.dataflows import (
    DEGRADED,
    FAILED,
    RESTARTING,
    colored_state,
    format_table,
    is_up_word,
)
from dora_systemd.decisions.views.facts import node_table, stopping_words
from dora_systemd.decisions.views.formats import (
    UNKNOWN,
    format_count,
    format_memory,
    format_percent,
    format_uptime,
    zoned_time,
)
from dora_systemd.decisions.views.inhibitors import format_holders
from dora_systemd.decisions.views.rows import DataflowRow, format_bundles
from dora_systemd.terminal_text import cut, one_line

_WITH_REASON = (FAILED, DEGRADED, RESTARTING)


def format_dataflow(row: DataflowRow, width: int | None = None, want_colors: bool = False) -> str:
    """The output of `doractl list SELECTOR`: the dataflow's values, then the table of its nodes.

    width: of the terminal. Nothing in the values can control it.
    """
    facts = (
        ("Dataflow", row.uuid),
        ("Name", row.name),
        ("Unit", row.unit),
        ("File", row.dataflow or UNKNOWN),
        ("Release", row.release),
        ("Machine", f"{row.machine}, the head is another one" if row.machine else ""),
        ("Machines", ", ".join((HEAD, *row.machines)) if row.machines else ""),
        ("Status", _status_words(row)),
        ("Uptime", format_uptime(row.uptime)),
        ("Started", zoned_time(row.started) if row.started else ""),
        ("Ready", zoned_time(row.ready) if is_up_word(row) else ""),
        ("Ended", zoned_time(row.ended) if row.ended else ""),
        ("Version", ": ".join(filter(None, row.upgrade))),
        ("Nodes", row.problem),
        ("CPU", _cpu_words(row)),
        ("Memory", _memory_words(row)),
        ("Outside", format_outside({one.node: one.containers for one in row.nodes})),
        ("Restarts", _restart_words(row)),
        ("Stopped", format_stopped({one.node: one.stopped_by for one in row.nodes})),
        ("Budget", budget_words(row.restart_budget) if row.restart_budget else ""),
        ("Inhibit", format_holders(row.inhibitors) if row.inhibitors else ""),
        ("Bundle", format_bundles(row.bundles)),
        ("At boot", "started" if row.enabled else ""),
        ("Reason", f"doractl why {row.name}" if row.status in _WITH_REASON else ""),
    )
    lines = [cut(one_line(f"{title + ':':<10}{text}"), width) for title, text in facts if text]
    if want_colors:
        lines = [colored_state(one, row.status) if one[:7] == "Status:" else one for one in lines]
    if not row.nodes:
        return "\n".join(lines)
    return "\n".join([*lines, "", format_table(*node_table(row.nodes), width, want_colors)])


def _restart_words(row: DataflowRow) -> str:
    """Whose restarts are which: systemd restarts the dataflow, dora restarts single nodes."""
    whole = f"{format_count(row.restarts)} of the dataflow by systemd"
    counts = [one.restarts for one in row.nodes if one.restarts is not None]
    return f"{whole}, {sum(counts)} of single nodes by dora" if counts else whole


def _status_words(row: DataflowRow) -> str:
    text = stopping_words(row.nodes) or row.text
    word = row.status.lower()
    if text == word or text.startswith((f"{word}, ", f"{word} for ")):
        text = text.removeprefix(word).lstrip(", ")
    return f"{row.status} ({text})" if text else row.status


def _cpu_words(row: DataflowRow) -> str:
    now = UNKNOWN if row.cpu_percent is None else f"{row.cpu_percent:.1f}%"
    if row.cpu_limit is None:
        return now
    return f"{now} of {row.cpu_limit:g}%, throttled {format_percent(row.throttled)}% of the time"


def _memory_words(row: DataflowRow) -> str:
    now = format_memory(row.memory)
    if row.memory_limit is not None:
        now = f"{now} of {format_memory(row.memory_limit)}"
    return now if row.memory_peak is None else f"{now} (peak {format_memory(row.memory_peak)})"
