"""The flags of `doractl start` that a Start request of the dora command means.

The dora command sends what `dora expand FILE` prints: modules are expanded, timers and defaults
normalized, and $VARIABLES replaced from its own environment. `--env` is added to the dataflow's
`env`, `--debug` to `debug`, and `--exit-when-nodes-finish`; here they become the same flags of
doractl. This was measured with dora 1.1.0.
"""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.descriptor.json_size import is_infinite
from dora_systemd.decisions.gateway.frames import Request
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted, scalar_text


def sent_flags(request: Request, written: Mapping[str, Any]) -> dict[str, object]:
    """The flags with which the file yields what was sent. written: the document in the file.

    Raises DoraSystemdError (BAD_INPUT) for a variable whose value the dora command could not send.
    """
    sent = _mapping(request.body.get("dataflow"))
    flags: dict[str, object] = {}
    if changed := _changed_env(_mapping(sent.get("env")), _mapping(written.get("env"))):
        flags["env"] = changed
    if _mapping(sent.get("debug")).get("enable_debug_inspection"):
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
        # JSON has no such numbers, so dora sends null; what the file says is read from there.
        if not is_infinite(old.get(key, "")):
            raise DoraSystemdError(
                f"cannot start: env {quoted(key)} is infinite or not a number, and dora lost it",
                "doractl start FILE keeps such values",
                ExitCode.BAD_INPUT,
            )
        new.pop(key)
    return tuple(f"{key}={value}" for key, value in new.items() if old.get(key) != value)


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
