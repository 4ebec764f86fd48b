"""Finds the file of a Start request, which has a descriptor and a directory, but no file name.

The dora command sends what `dora expand FILE` prints: modules are expanded, timers and defaults
normalized, and $VARIABLES replaced from its own environment. `--env` is added to the dataflow's
`env`, `--debug` to `debug`, and `--exit-when-nodes-finish`; here they become the same flags of
doractl. session_id is that of out/<stem>.dora-session.yaml beside the file. This was measured with
dora 1.1.0.
"""

from collections.abc import Mapping
from typing import Any

Descriptor = Mapping[str, Any]

_FROM_FLAGS = ("env", "debug", "exit_when_nodes_finish")
_DEFAULTS: Mapping[str, Any] = {"restart_policy": "never", "max_restarts": 0}


def could_be(written: object, sent: Descriptor) -> bool:
    """Whether a file with the document `written` can be the one sent: it has the same nodes."""
    if not isinstance(written, dict):
        return False
    names: list[str] = []
    modules: list[str] = []
    for node in _nodes(written):
        (modules if node.get("module") else names).append(str(node.get("id")))
    there = [str(node.get("id")) for node in _nodes(sent)]
    plain = [one for one in there if not one.startswith(tuple(f"{name}." for name in modules))]
    return bool(there) and sorted(names) == sorted(plain)


def sent_flags(
    sent: Descriptor, expanded: Descriptor, want_uv: bool, has_variables: bool
) -> dict[str, object] | None:
    """The flags with which the file yields what was sent; None for another dataflow.

    expanded: the result of `dora expand` for the file. has_variables: the file contains a "$",
    which the sender may have replaced by another value than we do.
    """
    rest = {key: value for key, value in sent.items() if key not in _FROM_FLAGS}
    own = {key: value for key, value in expanded.items() if key not in _FROM_FLAGS}
    env, own_env = _mapping(sent.get("env")), _mapping(expanded.get("env"))
    if not own_env.keys() <= env.keys() or not _same(rest, own, has_variables):
        return None
    flags: dict[str, object] = {}
    changed = {key: value for key, value in env.items() if own_env.get(key) != value}
    if changed:
        flags["env"] = tuple(f"{key}={_env_text(value)}" for key, value in changed.items())
    if _is_debug(sent) and not _is_debug(expanded):
        flags["debug"] = True
    ends = sent.get("exit_when_nodes_finish")
    if ends != expanded.get("exit_when_nodes_finish") and ends is not None:
        flags["exit_when_nodes_finish"] = ends
    if want_uv:
        flags["uv"] = True
    return flags


def _nodes(descriptor: Descriptor) -> list[Mapping[str, Any]]:
    nodes = descriptor.get("nodes")
    return [node for node in nodes if isinstance(node, dict)] if isinstance(nodes, list) else []


def _same(one: Any, other: Any, has_variables: bool, key: str = "") -> bool:
    if key == "env" and has_variables:
        return _mapping(one).keys() == _mapping(other).keys()
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        first, second = _plain(one), _plain(other)
        return first.keys() == second.keys() and all(
            _same(first[name], second[name], has_variables, name) for name in first
        )
    if isinstance(one, list) and isinstance(other, list):
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(_same(a, b, has_variables) for a, b in pairs)
    return bool(one == other)


def _plain(mapping: Mapping[str, Any]) -> dict[str, Any]:
    """Remove empty values: another version of dora may leave them out or add them."""
    return {
        key: value
        for key, value in mapping.items()
        if value is not None and value != [] and value != {} and value != _DEFAULTS.get(key)
    }


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _is_debug(descriptor: Descriptor) -> bool:
    return bool(_mapping(descriptor.get("debug")).get("enable_debug_inspection"))


def _env_text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
