"""Frames of dora's control protocol, seen from the coordinator's side. Pure.

The gateway parses requests of the dora command here, and formats the replies. The runner is a
client of the same protocol: ../dora/protocol.py. No document specifies all of it. This is what the
dora command 1.1.0 does on its one WebSocket, /api/control, measured with a proxy in front of a
coordinator; another version of dora may break it, so refused_version() accepts dora 1 only.

- The first request is Hello. The others follow one at a time, each with an `id`, and the command
  waits for each reply without a timeout.
- A reply is {"id", "result"}. A failure is {"result": {"Error": text}}, and the command prints the
  text as it is. A malformed frame gets "error" in place of "result".
- Without --node or a UUID the command looks up names in List, only among "Running" dataflows.
- The reply to LogSubscribe is {"subscribed": true}. The lines follow in frames without an id,
  {"event": "log", "payload"}. TopicSubscribe returns a subscription_id, and binary frames follow
  that begin with its 16 bytes.
- The command accepts messages of up to 64 MiB in frames of up to 16 MiB, and closes the connection
  above that. A coordinator's own frames end at 1 MiB, so its Logs fail above some 2,000 lines.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.descriptor.json_size import is_infinite
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import parse_uuid
from dora_systemd.terminal_text import escaped
from dora_systemd.values import SECOND, as_mapping, quoted, scalar_text

NO_ID = "00000000-0000-0000-0000-000000000000"
"""The id of a reply to a frame without one."""

LOGS_LIMIT = 15 << 20
"""Bytes of log in one answer: each takes up to 4 characters of a message of at most 64 MiB."""
_PART = 1 << 16
_NUL = r"(?<!\\)(?:\\\\)*\\u0000"
"""NUL as JSON escapes it; an escaped backslash in front of the text "u0000" does not match."""
_MICROSECOND_NS = 1000


@dataclass(frozen=True)
class Request:
    """One request."""

    id: str
    name: str  # a variant of dora's ControlRequest
    body: Mapping[str, Any] = field(default_factory=dict)  # its fields

    @property
    def params(self) -> str | dict[str, Any]:
        """The request as a coordinator expects it in `params`."""
        return {self.name: dict(self.body)} if self.body else self.name

    def text(self, key: str) -> str:
        """A required text field. Raises DoraSystemdError (BAD_INPUT)."""
        value = self.body.get(key)
        if isinstance(value, str) and value:
            return value
        raise bad_input(f"cannot read the request {self.name}: it has no {key}")

    @property
    def dataflow(self) -> str:
        """The UUID of the request's dataflow. Raises DoraSystemdError."""
        return parse_uuid(
            self.text("dataflow_id" if "dataflow_id" in self.body else "dataflow_uuid")
        )

    @property
    def grace(self) -> int | None:
        """The grace duration in µs, or None."""
        given = self.body.get("grace_duration")
        if not isinstance(given, dict):
            return None
        seconds, nanos = given.get("secs"), given.get("nanos")
        if not isinstance(seconds, int) or not isinstance(nanos, int):
            return None
        return max(seconds * SECOND + nanos // _MICROSECOND_NS, 0)

    @property
    def tail(self) -> int | None:
        """The requested number of lines, None for all."""
        given = self.body.get("tail")
        return given if isinstance(given, int) and given >= 0 else None


@dataclass(frozen=True)
class Malformed:
    """A frame that is not a request."""

    id: str
    reason: str  # for the reply


def parse_request(text: str | bytes) -> Request | Malformed:
    """The request in a frame of a client."""
    if isinstance(text, bytes):
        return Malformed(NO_ID, "cannot read a binary frame: requests are text")
    try:
        frame = json.loads(text)
        # encode() refuses half a surrogate pair, to which a coordinator would not reply at all.
        text = json.dumps(frame, ensure_ascii=False)
        text.encode()
    except (ValueError, RecursionError) as error:
        return Malformed(NO_ID, f"cannot read the request: {error}"[:300])
    if not isinstance(frame, dict) or not isinstance(frame.get("id"), str):
        return Malformed(NO_ID, "cannot read the request: it has no id")
    if re.search(_NUL, text):
        # Paths, names and arguments of programs cannot contain NUL: refuse it once, here.
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
    """The frame of a reply."""
    return json.dumps({"id": ident, "result": result})


def format_malformed(frame: Malformed) -> str:
    """The frame of the reply to a malformed frame."""
    return json.dumps({"id": frame.id, "error": frame.reason})


def format_event(payload: Mapping[str, Any]) -> str:
    """The frame of one line for a LogSubscribe."""
    return json.dumps({"event": "log", "payload": payload})


def error_result(error: DoraSystemdError) -> dict[str, str]:
    """The result for an error: the dora command prints it, with the hint in dora's own form."""
    text = error.message + (f"\n\n  hint: {error.hint}" if error.hint else "")
    return {"Error": escaped(text)}


def logs_parts(ident: str, lines: list[bytes]) -> Iterator[str]:
    """The reply to Logs in parts of one message: in dora's JSON, bytes are an array of numbers."""
    yield f'{{"id":{json.dumps(ident)},"result":{{"Logs":['
    data = b"".join(lines)
    for start in range(0, len(data), _PART):
        yield ("," if start else "") + ",".join(map(str, data[start : start + _PART]))
    yield "]}}"


def renamed(value: Any, old: str, new: str) -> Any:
    """`value` with every UUID `old` replaced by `new`."""
    return json.loads(json.dumps(value).replace(old, new)) if old else value


def refused_version(version: object) -> str | None:
    """Return why the gateway refuses a dora command of that version, or None."""
    text = version if isinstance(version, str) else ""
    if text.partition(".")[0] == "1":
        return None
    return (
        f"dora version mismatch: the gateway speaks with dora 1, this is {quoted(text)}; "
        "install dora-rs-cli 1.1"
    )


def sent_flags(request: Request, written: Mapping[str, Any]) -> dict[str, object]:
    """The flags of `doractl start` that a Start request means. written: the document in the file.

    The dora command sends what `dora expand FILE` prints: modules are expanded, timers and defaults
    normalized, and $VARIABLES replaced from its own environment. `--env` is added to the dataflow's
    `env`, `--debug` to `debug`, and `--exit-when-nodes-finish`. Raises DoraSystemdError (BAD_INPUT)
    for a variable whose value the dora command could not send.
    """
    sent = as_mapping(request.body.get("dataflow"))
    flags: dict[str, object] = {}
    if changed := _changed_env(as_mapping(sent.get("env")), as_mapping(written.get("env"))):
        flags["env"] = changed
    if as_mapping(sent.get("debug")).get("enable_debug_inspection"):
        flags["debug"] = True
    ends = sent.get("exit_when_nodes_finish")
    if ends is not None and ends != written.get("exit_when_nodes_finish"):
        flags["exit_when_nodes_finish"] = ends
    if request.body.get("uv"):
        flags["uv"] = True
    return flags


def _changed_env(sent: Mapping[str, Any], written: Mapping[str, Any]) -> tuple[str, ...]:
    # As text: dora sends the number 5 for "5".
    old = {key: scalar_text(value) for key, value in written.items()}
    new = {key: scalar_text(value) for key, value in sent.items()}
    for key in [key for key, value in sent.items() if value is None]:
        # JSON has no such numbers, so dora sends null; the runner reads the value from the file.
        if not is_infinite(old.get(key, "")):
            raise bad_input(
                f"cannot start: env {quoted(key)} is infinite or not a number, and dora lost it",
                "doractl start FILE keeps such values",
            )
        new.pop(key)
    return tuple(f"{key}={value}" for key, value in new.items() if old.get(key) != value)
