"""The frames of dora's control protocol as a coordinator has them, see also ../dora/protocol.py.

What the dora command 1.1.0 does on its one WebSocket, /api/control of DORA_COORDINATOR_ADDR and
DORA_COORDINATOR_PORT, measured by a proxy before a bare coordinator:

- Its first request is Hello; then one request after the other, each with `id`, and it waits for
  each reply without a limit. A reply is {"id", "result"}; what failed is {"result": {"Error":
  text}}, and the text is printed as it is; "error" in place of "result" is for a malformed frame.
- Without --node or a UUID it looks for names in List among those that are "Running" only.
- LogSubscribe is answered {"subscribed": true}; from then on the lines come as frames without an
  id, {"event": "log", "payload"}. TopicSubscribe gives a subscription_id, and binary frames that
  begin with its 16 bytes.
- It takes messages of up to 64 MiB in frames of up to 16 MiB, and drops the connection above; a
  bare coordinator's frames end at 1 MiB, so that its Logs fail above some 2,000 lines.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import parse_uuid
from dora_systemd.terminal_text import escaped
from dora_systemd.values import SECOND, quoted

NO_ID = "00000000-0000-0000-0000-000000000000"
"""The id of a reply to a frame that has none."""

LOGS_LIMIT = 15 << 20
"""Bytes of one answer to Logs: each becomes up to 4 characters of a message of at most 64 MiB."""
_PART = 1 << 16
_NUL = re.compile(r"(?<!\\)(?:\\\\)*\\u0000")
"""As json writes it, and no backslash before "u0000" that is meant as one."""
_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class Request:
    """One request. name: a variant of dora's ControlRequest. body: its fields."""

    id: str
    name: str
    body: Mapping[str, Any] = field(default_factory=dict)

    @property
    def params(self) -> str | dict[str, Any]:
        """As a coordinator takes it."""
        return {self.name: dict(self.body)} if self.body else self.name

    def text(self, key: str) -> str:
        """A field that must be there. Raises DoraSystemdError (BAD_INPUT)."""
        value = self.body.get(key)
        if isinstance(value, str) and value:
            return value
        raise DoraSystemdError(
            f"cannot read the request {self.name}: it has no {key}", "", ExitCode.BAD_INPUT
        )

    @property
    def dataflow(self) -> str:
        """The UUID of the dataflow that it is about. Raises DoraSystemdError."""
        return parse_uuid(
            self.text("dataflow_id" if "dataflow_id" in self.body else "dataflow_uuid")
        )

    @property
    def grace(self) -> int | None:
        """Its grace duration in µs, None where it has none."""
        given = self.body.get("grace_duration")
        if not isinstance(given, dict):
            return None
        seconds, nanos = given.get("secs"), given.get("nanos")
        if not isinstance(seconds, int) or not isinstance(nanos, int):
            return None
        return max(seconds * SECOND + nanos // _MICROSECOND_NS, 0)

    @property
    def tail(self) -> int | None:
        """How many lines are asked for, None for all."""
        given = self.body.get("tail")
        return given if isinstance(given, int) and given >= 0 else None


@dataclass(frozen=True)
class Malformed:
    """A frame that is no request."""

    id: str
    reason: str


def parse_request(text: str | bytes) -> Request | Malformed:
    """The request in a frame of a client."""
    if isinstance(text, bytes):
        return Malformed(NO_ID, "cannot read a binary frame: requests are text")
    try:
        frame = json.loads(text)
        # Half a surrogate pair is no text to anybody else: a coordinator would not answer at all.
        text = json.dumps(frame, ensure_ascii=False)
        text.encode()
    except (ValueError, RecursionError) as error:
        return Malformed(NO_ID, f"cannot read the request: {error}"[:300])
    if not isinstance(frame, dict) or not isinstance(frame.get("id"), str):
        return Malformed(NO_ID, "cannot read the request: it has no id")
    if _NUL.search(text):
        # No path, no name and no argument of a program can have one: what takes it would fail.
        return Malformed(frame["id"], "cannot read the request: it has a NUL character")
    return _parse_params(frame["id"], frame.get("params"))


def _parse_params(ident: str, params: Any) -> Request | Malformed:
    if isinstance(params, str):
        return Request(ident, params)
    if isinstance(params, dict) and len(params) == 1:
        name, body = next(iter(params.items()))
        if body is None or isinstance(body, dict):
            return Request(ident, name, body or {})
    return Malformed(ident, "cannot read the request: params is not a request of dora's")


def format_result(ident: str, result: Any) -> str:
    """The frame of an answer."""
    return json.dumps({"id": ident, "result": result})


def format_malformed(frame: Malformed) -> str:
    """The frame of the answer to one that cannot be read."""
    return json.dumps({"id": frame.id, "error": frame.reason})


def format_event(payload: Mapping[str, Any]) -> str:
    """The frame of one line of a log that is followed."""
    return json.dumps({"event": "log", "payload": payload})


def error_result(error: DoraSystemdError) -> dict[str, str]:
    """What failed, as the dora command prints it, with the hint as its own are."""
    text = error.message + (f"\n\n  hint: {error.hint}" if error.hint else "")
    return {"Error": escaped(text)}


def logs_parts(ident: str, lines: list[bytes]) -> Iterator[str]:
    """The answer to Logs in parts of one message: dora sends bytes as an array of numbers."""
    yield f'{{"id":{json.dumps(ident)},"result":{{"Logs":['
    separator = ""
    for part in _joined(lines):
        yield separator + ",".join(map(str, part))
        separator = ","
    yield "]}}"


def _joined(lines: list[bytes]) -> Iterator[bytes]:
    part = bytearray()
    for line in lines:
        part += line
        if len(part) >= _PART:
            yield bytes(part)
            part.clear()
    if part:
        yield bytes(part)


def renamed(value: Any, old: str, new: str) -> Any:
    """`value` with the UUID `new` wherever it has `old`."""
    return json.loads(json.dumps(value).replace(old, new)) if old else value


def refused_version(version: object) -> str | None:
    """Why a dora command of that version is turned away, or None."""
    text = version if isinstance(version, str) else ""
    if text.partition(".")[0] == "1":
        return None
    return (
        f"dora version mismatch: the gateway speaks with dora 1, this is {quoted(text)}; "
        "install dora-rs-cli 1.1"
    )
