"""The setting `record`: which last messages of the outputs are kept, and in how much memory.

The setting is in decisions/settings/record.py.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.extra import RECORDER, check_ids
from dora_systemd.decisions.cell.machines import placed_on
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.values import (
    INFINITY,
    SECOND,
    format_duration,
    format_size,
    parse_bool,
    parse_duration,
    parse_size,
    quoted,
)

KEYS = ("last", "memory", "outputs")
MEGABYTE = 1024 * 1024
ROOM = 160 * MEGABYTE
"""Bytes that the recorder has at least besides the ring: Python, pyarrow, messages on their way."""
_SHARE = 8
"""The recorder may use this part of a machine's memory: 64 messages of all outputs can be on their
way, of any size, because no queue of dora's is shorter. 6 MB 30 times a second need 70 MB, and
200 MB if the recorder gets no CPU time for seconds."""
_LEAST = MEGABYTE
_FORM = "last=30s,memory=200M,outputs=NODE/OUTPUT+NODE/OUTPUT"
_HINT = f"write {_FORM}, any of these keys; yes or no"


class Record(NamedTuple):
    """What the recorder keeps."""

    last: int = 10 * SECOND  # µs of messages before the last one of each output
    memory: int = 32 * MEGABYTE  # bytes of all messages
    # those to record, NODE/OUTPUT; empty: all, but of large messages only the last one
    outputs: tuple[str, ...] = ()


def parse_record(text: str) -> Record | None:
    """The inverse of format_record; keys may be left out. Raises DoraSystemdError (USAGE)."""
    if "=" not in text:
        try:
            return Record() if parse_bool(text) else None
        except DoraSystemdError as error:
            raise _wrong(f"{quoted(text)} is none", _HINT) from error
    pairs = [part.partition("=") for part in text.split(",")]
    values = {key.strip(): value for key, equals, value in pairs if equals}
    if len(values) != len(pairs):
        raise _wrong(f"{quoted(text)} is none", _HINT)
    names = values.pop("outputs", "")
    return record_of(values, names.split("+") if names else ())


def record_of(values: Mapping[str, str], outputs: Sequence[str] = ()) -> Record:
    """The value from its KEYS as texts. Raises DoraSystemdError (USAGE)."""
    for key in values:
        if key not in KEYS:
            raise _wrong(
                f"unknown key {quoted(key)}",
                did_you_mean(key, KEYS) or f"valid keys: {', '.join(KEYS)}",
            )
    default = Record(outputs=tuple(dict.fromkeys(map(_output, outputs))))
    return default._replace(
        last=_time(values["last"]) if "last" in values else default.last,
        memory=_memory(values["memory"]) if "memory" in values else default.memory,
    )


def _output(text: str) -> str:
    name = text.strip()
    node, _, output = name.partition("/")
    if not node or not output or not name.isprintable():
        raise _wrong(f"{quoted(text)} is no output", "write NODE/OUTPUT, such as camera/image")
    return name


def _time(text: str) -> int:
    time = parse_duration(text)
    if not SECOND <= time < INFINITY:
        raise _wrong(f"last is {quoted(text)}", "write a time such as 30s, of a second or more")
    return time


def _memory(text: str) -> int:
    size = parse_size(text)
    if not _LEAST <= size < INFINITY:
        raise _wrong(f"memory is {quoted(text)}", "write a size such as 200M, of 1M or more")
    return size


def _wrong(reason: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot read what to record: {reason}", hint)


def format_record(record: Record | None) -> str:
    """Format for the runner's command line."""
    if record is None:
        return "no"
    last = format_duration(record.last)
    names = f",outputs={'+'.join(record.outputs)}" if record.outputs else ""
    return f"last={last},memory={format_size(record.memory)}{names}"


def check_record(record: Record | None, options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for an output that no node has. nodes: expanded."""
    if record is None:
        return
    by_id = {node.id: node for node in nodes}
    known = sorted(f"{node.id}/{output}" for node in nodes for output in node.outputs)
    for name in record.outputs:
        node = by_id.get(name.partition("/")[0])
        # ros2 nodes get outputs from their topics.
        if name not in known and (node is None or node.kind is not NodeKind.ROS2):
            hint = did_you_mean(name, known) or f"outputs: {', '.join(known) or 'none'}"
            raise bad_input(f"cannot record {quoted(name)}: no such output", hint)
        if machine := placed_on(options.placed, name.partition("/")[0]):
            hint = "only outputs of nodes on the machine of the dataflow's unit can be recorded"
            raise bad_input(f"cannot record {quoted(name)}: it is on machine {machine}", hint)
    check_ids("record outputs", RECORDER, by_id)


def check_memory(record: Record, total: int) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the machine has no such memory. total: its bytes."""
    if record.memory + ROOM > total:
        has = f"this machine has {format_size(total // MEGABYTE * MEGABYTE)}"
        own = f"{format_size(record.memory)} and {format_size(ROOM)} for the recorder"
        raise bad_input(f"cannot record in {own}: {has}", "lower memory: of record")


def limit_of(record: Record, total: int) -> int:
    """Bytes that the group of the recorder may use. total: bytes of the machine."""
    return record.memory + max(ROOM, total // _SHARE)


def recorded_outputs(
    record: Record, options: RunnerOptions, nodes: Sequence[Node]
) -> tuple[str, ...]:
    """The outputs to record: those that are named, else all of the nodes on this machine."""
    if record.outputs:
        return record.outputs
    here = (node for node in nodes if not placed_on(options.placed, node.id))
    return tuple(sorted(f"{node.id}/{output}" for node in here for output in node.outputs))
