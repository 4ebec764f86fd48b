"""Makes an MCAP file of a ring: a channel for each output, and metadata records with the facts."""

from collections.abc import Mapping
from typing import NamedTuple

from dora_systemd import __version__
from dora_systemd.decisions.recorder.mcap import McapWriter, Write
from dora_systemd.decisions.recorder.reading import Reading, Recorded

ENCODING = "arrow"
"""Encoding of messages and schemas: encapsulated IPC messages of Arrow, a schema and its record
batches, which have one column, `value`."""
JSON = "json"
META = "#metadata"
"""What follows NODE/OUTPUT in the topic of dora's metadata, which are JSON."""
RUN, OUTPUT = "dora-systemd", "dora-systemd output"
"""Names of the metadata records: of the file, and of each output."""
FIELDS = ("received", "dropped", "evicted", "too_large", "largest")
"""Of State, in the metadata record of an output."""
_NOTHING = (b"", b"{}")


class Written(NamedTuple):
    """What a file has."""

    messages: int
    outputs: int  # with at least one message
    losses: int  # messages that were received, or dropped by dora, and are not in the file
    damaged: int
    is_cut: bool  # whether there was more than may be read


def write_recording(reading: Reading, write: Write, facts: Mapping[str, str]) -> Written:
    """Write all messages of a ring. facts: in addition to those in its header."""
    file, names = McapWriter(write, f"dora-systemd {__version__}"), reading.header.outputs
    recorded = [0] * len(names)
    for message in reading.messages():
        if _add(file, names[message.output], message):
            recorded[message.output] += 1
    losses = 0
    for name, state, count in zip(names, reading.states, recorded, strict=True):
        lost = max(state.dropped + state.evicted + state.too_large, 0)
        losses += lost
        numbers = {key: str(getattr(state, key)) for key in FIELDS}
        file.add_metadata(OUTPUT, {"output": name, "recorded": str(count), **numbers})
    whole = {"damaged": str(reading.damaged), "cut": "yes" if reading.is_cut else "no"}
    file.add_metadata(RUN, {**reading.header.facts, **facts, **whole})
    file.finish()
    outputs = sum(one > 0 for one in recorded)
    return Written(sum(recorded), outputs, losses, reading.damaged, reading.is_cut)


def _add(file: McapWriter, topic: str, message: Recorded) -> bool:
    """Whether the file has the message now."""
    channel, head = file.channel(topic, ENCODING, message.schema), message.head
    if channel is None or not message.schema:
        return False
    times = head.received_ns, head.sent_ns or head.received_ns
    file.message(channel, head.number, *times, message.data)
    if message.meta not in _NOTHING and (own := file.channel(topic + META, JSON)) is not None:
        file.message(own, head.number, *times, message.meta)
    return True
