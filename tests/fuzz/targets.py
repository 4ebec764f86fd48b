"""Everything that reads other people's bytes, as functions of bytes.

A target returns for every input, or raises what its reader documents. Anything else is a defect.
A new reader is one new line in TARGETS, and a file with a good example in corpus/NAME/.
"""

import json
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.dora.command import parse_dora_version, version_numbers
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.adapters.host.yaml_edit import with_value
from dora_systemd.adapters.runner_socket.client import parse_line
from dora_systemd.decisions.advice.evidence import collect
from dora_systemd.decisions.advice.rules import Current, advise
from dora_systemd.decisions.bundles.manifest import parse_manifest
from dora_systemd.decisions.cell.environment import SET_VARIABLE, changes_of
from dora_systemd.decisions.cell.environment_file import parse_environment_file
from dora_systemd.decisions.cell.exits import parse_exit
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow, parse_session
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.decisions.dora.life_events import parse_daemon_line, parse_life_event
from dora_systemd.decisions.dora.protocol import (
    LogRecord,
    Reply,
    parse_coordinator,
    parse_frame,
    parse_heartbeat,
    parse_heartbeats,
    parse_results,
    parse_spawn_failure,
)
from dora_systemd.decisions.gateway.frames import Malformed, format_malformed, parse_request
from dora_systemd.decisions.gateway.page_messages import parse_message, shown_values
from dora_systemd.decisions.gateway.request import has_token, refuse_address
from dora_systemd.decisions.gateway.timeline import MOST_MARKS, Now, Use, parse_use, timeline_values
from dora_systemd.decisions.life.refusal import parse_refusal
from dora_systemd.decisions.logs.lines import (
    LineEncoder,
    LineSplitter,
    Origin,
    dora_log_fields,
    json_fields,
    jsonl_fields,
)
from dora_systemd.decisions.logs.records import parse_filter
from dora_systemd.decisions.machines import wire
from dora_systemd.decisions.machines.description import Facts, parse_facts, problems, summary
from dora_systemd.decisions.needs.links import link_problem, parse_link
from dora_systemd.decisions.properties.assignments import parse_property
from dora_systemd.decisions.recorder.mcap_reader import McapReader
from dora_systemd.decisions.recorder.reading import Reading
from dora_systemd.decisions.recorder.ring import ALIGN
from dora_systemd.decisions.recorder.writer import Writer
from dora_systemd.decisions.releases.parcel import (
    format_parcel,
    missing,
    parse_parcel,
    parse_wants,
)
from dora_systemd.decisions.releases.program_versions import parse_versions
from dora_systemd.decisions.releases.progress import soaking
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.settings.table import NODES, SETTINGS
from dora_systemd.decisions.why.lives import Life, find_lives, parse_happening
from dora_systemd.decisions.why.stack import Crash, dump_frames, find_dump, python_frames
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import name_from_path, parse_name, parse_uuid
from dora_systemd.terminal_text import one_line, shown_log, without_sequences
from dora_systemd.values import parse_bool, parse_cpu, parse_duration, parse_size
from tests.unit.fakes.recorder.ring import PAGE, MemoryStore

FILE = Path("/fuzz/dataflow.yml")
_RING_PART, _RING_PARTS = 512, 4
"""Bytes of each part of a ring in the corpus, and number of parts: header, state, tape."""
SMALL_LIMIT = 8
"""Bytes of a line, small so that short inputs have long lines."""


@dataclass(frozen=True)
class Target:
    """One reader. raises: what it documents for input that is not valid."""

    read: Callable[[bytes], object]
    raises: tuple[type[Exception], ...] = ()

    def feed(self, data: bytes) -> None:
        """Read `data`; raises for a defect only."""
        with suppress(*self.raises):
            self.read(data)


def text_of(data: bytes) -> str:
    """What arrives as text: valid Unicode, any of it."""
    return data.decode("utf-8", "replace")


def loaded(data: bytes) -> Any:
    """The JSON value in `data`, or the text of it."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return text_of(data)


def _yaml(data: bytes) -> object:
    return parse_yaml(decoded(data, FILE), FILE, allow_empty=True)


def _settings(data: bytes) -> object:
    return resolve_settings({}, {}, [(str(FILE), _yaml(data))], SETTINGS)


def _request(data: bytes) -> object:
    request = parse_request(text_of(data))
    if isinstance(request, Malformed):
        format_malformed(request).encode()
    return request


def _reply(data: bytes) -> object:
    reply = parse_frame(text_of(data))
    if isinstance(reply, Reply):
        daemons = (parse_heartbeat(reply), parse_heartbeats(reply))
        return daemons, parse_results(reply), parse_spawn_failure(reply)
    return parse_life_event(reply, 1) if isinstance(reply, LogRecord) else None


def _machine_line(data: bytes) -> None:
    """A message that is understood can be said again."""
    message = wire.parse_message(data)
    assert wire.parse_message(wire.format_message(message)) == message


def _machine_facts(data: bytes) -> None:
    """What is understood can be compared and shown."""
    facts = parse_facts(text_of(data))
    assert parse_facts(facts.to_json()) == facts
    own = Facts("0.1.0", "1.1.0", "/usr/bin/doractl", "alice", True, 5)
    shown = [*problems(own, facts, facts.now - own.now), summary(facts, facts.now - own.now)]
    str(shown).encode()


def _ring(data: bytes) -> None:
    """The corpus has the parts of a ring without the holes between them."""
    header, rest = data[:_RING_PART], data[_RING_PART:]
    store = MemoryStore(_RING_PARTS * ALIGN)
    for at in range(_RING_PARTS):
        part = header if at == 0 else rest[(at - 1) * _RING_PART : at * _RING_PART]
        store.write(at * ALIGN, [part])
    size = sum(one.head.size for one in Reading(store, store.size, ALIGN).messages())
    assert size <= ALIGN
    Writer(store, PAGE)


def _recording(data: bytes) -> None:
    found = McapReader(lambda at, size: data[at : at + size], len(data), 1000)
    for topic in found.topics("arrow"):
        last = found.last(topic)
        assert last is None or len(last.data) <= 1000


def _encoded(fields: Any) -> None:
    """What goes into the journal is text that can be encoded."""
    for value in (fields or {}).values():
        str(value).encode()


def _splitter(data: bytes) -> None:
    whole, parts = LineSplitter(SMALL_LIMIT), LineSplitter(SMALL_LIMIT)
    once = [*whole.feed(data), *whole.flush()]
    pieces = [line for byte in data for line in parts.feed(bytes([byte]))] + parts.flush()
    assert once == pieces
    assert b"".join(once) == data.replace(b"\n", b"").replace(b"\r", b"")


def _encoder(data: bytes) -> bytes:
    encoder = LineEncoder(Origin("name", "uuid", "node"), "stdout")
    return encoder.entry(data.replace(b"\n", b""))


def _edit(data: bytes) -> None:
    """A settings file that `advise --apply` changes: what it makes is still YAML, or refused."""
    text = decoded(data, FILE)
    parse_yaml(text, FILE, allow_empty=True)
    for place in (("memory_limit",), ("nodes", "a", "stop", "within"), ("nodes", "a", "owes", "x")):
        if (after := with_value(text, place, "1G")) is not None:
            with suppress(DoraSystemdError):
                parse_yaml(after, FILE)


def _advice(data: bytes) -> object:
    return advise(collect(_lives(data), {}), Current(frozenset({"camera", "a"})))


def _happenings(data: bytes) -> list[Any]:
    records = [loaded(line) for line in data.splitlines()]
    found = [parse_happening(record) for record in records if isinstance(record, dict)]
    return [one for one in found if one is not None]


def _lives(data: bytes) -> list[Life]:
    return find_lives(_happenings(data))


def _timeline(data: bytes) -> None:
    records = filter(None, map(loaded, data.splitlines()))
    used = dict(filter(None, (parse_use(one) for one in records if isinstance(one, dict))))
    for now in (Now("boot", 1, Use(1, 1)), Now("boot")):
        found = timeline_values(_happenings(data), "u", now, used)
        assert json.dumps(shown_values(found, MOST_MARKS)).isprintable()


def _stack(data: bytes) -> None:
    text = text_of(data)
    frames = [*dump_frames(text), *python_frames(text.split("\n")[::-1])]
    assert all(len(f"{one.function}{one.place}") <= 240 for one in frames)
    assert len(frames) <= 40
    if isinstance(record := loaded(data), dict):
        find_dump([record], "dora-a.service", Crash("a", 11, None, 0, 1))


def _table(data: bytes) -> None:
    status = CellStatus.from_json(data)
    assert CellStatus.from_json(status.to_json()) == status


def _terminal(data: bytes) -> None:
    shown = shown_log(data)
    assert b"\x1b]" not in shown
    assert "\n" not in one_line(text_of(data))
    without_sequences(text_of(data))


def _of_text(*readers: Callable[[str], object]) -> Callable[[bytes], None]:
    """Each of these reads the same text, whatever the others say of it."""

    def read(data: bytes) -> None:
        for reader in readers:
            with suppress(DoraSystemdError):
                reader(text_of(data))

    return read


def _changes(text: str) -> object:
    return changes_of({SET_VARIABLE: text})


def _link(data: bytes) -> None:
    link = parse_link(data, 1)
    assert link is None or link_problem(link) in ("", "down", "bus-off", "no carrier")


def _parcel(data: bytes) -> None:
    parcel = parse_parcel(data)
    assert parse_parcel(format_parcel(parcel)) == parcel
    assert parse_wants({"wants": missing(parcel, {})}, parcel) == parcel.contents
    for path in (*parcel.files, parcel.dataflow, parcel.directory or "."):
        path.encode()
        assert not path.startswith("/")


def _bundle(data: bytes) -> None:
    """What is accepted as a whole can be read in parts."""
    fd = os.memfd_create("bundle")
    try:
        os.write(fd, data)
        with opened(Path(f"/proc/self/fd/{fd}")) as found:
            found.check()
            for part in found.manifest.parts:
                assert len(found.read(part.name)) == part.size
    finally:
        os.close(fd)


REFUSED = (DoraSystemdError,)

TARGETS = {
    "status": Target(_table, REFUSED),
    "descriptor": Target(lambda data: parse_dataflow(_yaml(data), "dataflow.yml"), REFUSED),
    "settings": Target(_settings, REFUSED),
    "session": Target(lambda data: parse_session(_yaml(data)), REFUSED),
    "environment": Target(lambda data: parse_environment_file(text_of(data), "env"), REFUSED),
    "control-request": Target(_request),
    "dora-reply": Target(_reply),
    "page-message": Target(lambda data: parse_message(text_of(data)), REFUSED),
    "runner-socket": Target(parse_line),
    "machine-line": Target(_machine_line, REFUSED),
    "machine-facts": Target(_machine_facts, REFUSED),
    "coordinator": Target(lambda data: parse_coordinator(loaded(data)), (ValueError,)),
    "address": Target(lambda data: refuse_address([text_of(data)], [text_of(data)])),
    "token": Target(lambda data: has_token([text_of(data)], "0" * 64)),
    "jsonl": Target(lambda data: _encoded(jsonl_fields(data))),
    "json-line": Target(lambda data: _encoded(json_fields(data))),
    "dora-line": Target(lambda data: _encoded(dora_log_fields(data))),
    "line-splitter": Target(_splitter),
    "line-encoder": Target(_encoder),
    "journal": Target(_lives),
    "timeline": Target(_timeline),
    "advice": Target(_advice),
    "edit": Target(_edit, REFUSED),
    "stack": Target(_stack),
    "daemon-line": Target(lambda data: parse_daemon_line(text_of(data), 1)),
    "terminal": Target(_terminal),
    "check-versions": Target(lambda data: parse_versions(text_of(data))),
    "status-text": Target(lambda data: soaking(text_of(data), 1, 2)),
    "refusal": Target(lambda data: [parse_refusal(text_of(data), n) for n in range(80)]),
    "property": Target(lambda data: parse_property(text_of(data)), REFUSED),
    "values": Target(_of_text(parse_size, parse_duration, parse_cpu, parse_bool)),
    "names": Target(_of_text(parse_name, parse_uuid, name_from_path)),
    "limits": Target(_of_text(lambda text: NODES.kind.parse(text.split(";"), None), _changes)),
    "exit": Target(_of_text(parse_exit, parse_dora_error, parse_filter)),
    "parcel": Target(_parcel, REFUSED),
    "ring": Target(_ring, (ValueError,)),
    "recording": Target(_recording, (ValueError,)),
    "link": Target(_link),
    "bundle": Target(_bundle, REFUSED),
    "manifest": Target(lambda data: parse_manifest(data, "x.tar"), REFUSED),
    "dora-version": Target(
        lambda data: version_numbers(parse_dora_version(text_of(data)) or text_of(data))
    ),
}
