"""The part of a dataflow descriptor that dora-systemd reads. Other keys pass to dora unchanged.

The checks report errors in one line for which dora prints ten lines, or nothing: `nodes: []` would
run forever, and only `dora validate` finds an input without a source. dora checks everything else.

Also here: which nodes depend on which, what `dora build` saves next to the descriptor, and the
variables in values of `env:`, such as ${HOME}. The dora command replaces these when it reads the
file. Of a supervised dataflow dora reads the descriptor in the unit, which has another environment.
So doractl passes the caller's values to the runner. The runner replaces the variables and escapes
the result, because dora's coordinator and dora's daemon each replace variables again (measured with
dora 1.1).
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from dora_systemd.decisions.descriptor.json_size import check_json, is_infinite, refusal
from dora_systemd.decisions.descriptor.nodes import (
    UNEXPANDED,
    Node,
    NodeKind,
    described,
    mapping_of,
    parse_node,
)
from dora_systemd.values import as_mapping, quoted

MAX_JSON = 1024 * 1024 - 4096
"""Maximum bytes of a descriptor as JSON: dora refuses control frames above 1 MiB in total."""

_DORA_SOURCES = "dora/"


class Dataflow(NamedTuple):
    """A descriptor."""

    source: str  # the name of its file in messages
    nodes: tuple[Node, ...]
    env: Mapping[str, object]
    exit_when_nodes_finish: bool | None
    raw: Mapping[str, object]  # the complete mapping

    def node(self, node_id: str) -> Node | None:
        return next((node for node in self.nodes if node.id == node_id), None)


def parse_dataflow(document: object, source: str) -> Dataflow:
    """The dataflow in a loaded YAML or JSON document. source: its name in errors.

    Raises DoraSystemdError (BAD_INPUT) with file and node if there is no node, an id is repeated or
    not valid in dora, an input has no source, a value has a type that dora cannot read, or the
    document does not fit into one control frame of dora (1 MiB as JSON).
    """
    if not isinstance(document, dict):
        hint = "a dataflow is a mapping with the key 'nodes'"
        raise refusal(source, f"it holds {described(document)}", hint)
    document = {**_with_finite_env(document)}
    nodes = document.get("nodes")
    if isinstance(nodes, list):
        document["nodes"] = nodes = [_with_finite_env(node) for node in nodes]
    check_json(document, source, MAX_JSON)
    if not nodes or not isinstance(nodes, list):
        reason = "it has no nodes" if not nodes else f"'nodes' is {described(nodes)}"
        raise refusal(source, reason, "list at least one node below 'nodes:'")
    parsed = [parse_node(node, place, source) for place, node in enumerate(nodes)]
    exits = document.get("exit_when_nodes_finish")
    dataflow = Dataflow(
        source=source,
        nodes=tuple(_with_kept_output(parsed)),
        env=mapping_of(document.get("env"), source, "'env'"),
        exit_when_nodes_finish=exits if isinstance(exits, bool) else None,
        raw=document,
    )
    _check_ids(dataflow)
    _check_wiring(dataflow)
    return dataflow


def _with_finite_env(part: Any) -> Any:
    """A dataflow or node, with `.inf` and `.nan` in `env:` as texts, as dora has them."""
    env = as_mapping(as_mapping(part).get("env"))
    odd = {key: str(one) for key, one in env.items() if isinstance(one, float) and is_infinite(one)}
    return {**part, "env": {**env, **odd}} if odd else part


def _with_kept_output(nodes: Sequence[Node]) -> Iterator[Node]:
    """The nodes; dora must read the output of those with an input dora/logs[/LEVEL[/NODE]]."""
    sources = (given.source.split("/", 3) for one in nodes for given in one.inputs)
    read = {(*one[3:],) for one in sources if one[:2] == ["dora", "logs"]}
    for node in nodes:
        yield node._replace(keeps_output=True) if {(), (node.id,)} & read else node


def _check_ids(dataflow: Dataflow) -> None:
    seen: set[str] = set()
    for node in dataflow.nodes:
        if node.id in seen:
            hint = "every node needs an id of its own"
            raise refusal(dataflow.source, f"two nodes have the id {node.id}", hint)
        seen.add(node.id)


def _check_wiring(dataflow: Dataflow) -> None:
    nodes = {node.id: node for node in dataflow.nodes}
    for node in dataflow.nodes:
        for given in node.inputs:
            reason = _missing(given.source, nodes)
            if reason:
                hint = "an input comes from NODE/OUTPUT, where NODE lists OUTPUT in its outputs"
                where = f"node {node.id}: input {quoted(given.name)} comes from"
                raise refusal(dataflow.source, f"{where} {quoted(given.source)}, {reason}", hint)


def _missing(source: str, nodes: Mapping[str, Node]) -> str:
    """Return what is wrong with the source of an input, or ""."""
    origin, slash, output = source.partition("/")
    if source.startswith(_DORA_SOURCES):
        return ""
    if not slash:
        return "which names no output"
    if origin not in nodes:
        # The nodes of an expanded module have names MODULE.NODE.
        is_inside = nodes.get(origin.partition(".")[0])
        return "" if is_inside and is_inside.kind in UNEXPANDED else "a node that does not exist"
    node = nodes[origin]
    # ros2 nodes get outputs from their topics.
    if node.kind in UNEXPANDED or node.kind == NodeKind.ROS2 or output in node.outputs:
        return ""
    return "an output that it does not declare"


Downstream = Mapping[str, tuple[str, ...]]
"""Node id -> the nodes that depend on its outputs, nearest first."""


def downstream_of(dataflow: Dataflow) -> Downstream:
    """The nodes downstream of each node, directly or indirectly; a circle ends at its start."""
    takers: dict[str, list[str]] = {node.id: [] for node in dataflow.nodes}
    for node in dataflow.nodes:
        for origin in {one.source.partition("/")[0] for one in node.inputs}:
            takers.setdefault(origin, []).append(node.id)
    return {node.id: _reached(node.id, takers) for node in dataflow.nodes}


def _reached(start: str, takers: Mapping[str, list[str]]) -> tuple[str, ...]:
    found, waiting = {start}, [start]
    for node in waiting:  # the list grows during the loop
        new = [one for one in takers.get(node, ()) if one not in found]
        found.update(new)
        waiting += new
    return tuple(waiting[1:])


class BuildSession(NamedTuple):
    """The results of the last `dora build` for `dora start`, by node id, as absolute paths."""

    # where a node runs; for one from git that is its clone
    directories: Mapping[str, str] = {}
    # virtual environments of `dora build --uv`; without --uv they do not exist
    envs: Mapping[str, str] = {}


def session_path(dataflow: str) -> PurePath:
    """The session file of the descriptor at `dataflow`."""
    path = PurePath(dataflow)
    return path.parent / "out" / f"{path.stem}.dora-session.yaml"


def parse_session(document: object) -> BuildSession:
    """The session in a loaded YAML document; empty if dora did not write it."""
    build = as_mapping(as_mapping(document).get("local_build"))
    directories, envs = (build.get(key) for key in ("node_working_dirs", "python_env_dirs"))
    return BuildSession(_texts(directories), _texts(envs))


def _texts(value: object) -> dict[str, str]:
    return {str(key): str(text) for key, text in as_mapping(value).items()}


_NAME = "[A-Za-z_][A-Za-z0-9_]*"
_SHORT = rf"\$\$|\$(?P<plain>{_NAME})"
_LONG = rf"\$\{{(?P<name>{_NAME})(?::-(?P<default>[^}}]*))?\}}"
_REFERENCE = f"{_SHORT}|{_LONG}"

_DOLLAR = "$$$$"
"""A "$" that coordinator and daemon have both halved."""

_UNTIL_DAEMON = "$${DORA_SYSTEMD_NUMBER:-%s}"
"""A text that only the daemon reads as a number. dora makes a float of "inf" and "nan". If the
coordinator did, its JSON could not hold it, and the daemon would never answer."""

_OF_THE_UNIT = {
    *("HOME", "USER", "LOGNAME", "SHELL", "PATH", "PWD", "VIRTUAL_ENV", "TMPDIR"),
    *("XDG_RUNTIME_DIR", "INVOCATION_ID", "JOURNAL_STREAM", "NOTIFY_SOCKET", "RUNTIME_DIRECTORY"),
}
"""Variables that systemd sets or that describe the nodes' user, see systemd.exec(5)."""


_ALWAYS = "RUST_LOG"
"""The level of dora's own log, and of nodes in Rust: dora passes it on from the caller as well."""


def called_variables(dataflow: Dataflow, caller: Mapping[str, str]) -> dict[str, str]:
    """RUST_LOG and the variables of the caller that values of `env:` name, except the unit's."""
    named = dict.fromkeys(name for text in _texts_in(dataflow) for name in _names_in(text))
    named |= {_ALWAYS: None}
    return {name: caller[name] for name in named if name in caller and name not in _OF_THE_UNIT}


def expanded(env: Mapping[str, object], environment: Mapping[str, str]) -> dict[str, object]:
    """The values of `env:` as they must be sent, so that nodes get what `dora run` gives them.

    A variable that is not set stays, for dora to report.
    """

    def replaced(match: re.Match[str]) -> str:
        found = match.groupdict()
        name: str | None = found["plain"] or found.get("name")
        value: str | None = environment.get(name, found.get("default")) if name else "$"
        return match[0] if value is None else value.replace("$", _DOLLAR)

    def replaced_in(text: str) -> str:
        whole, rest = _parts(text)
        return re.sub(_REFERENCE, replaced, whole) + re.sub(_SHORT, replaced, rest)

    return {
        key: _until_daemon(replaced_in(value)) if isinstance(value, str) else value
        for key, value in env.items()
    }


def unset_variables(dataflow: Dataflow, environment: Mapping[str, str]) -> list[str]:
    """Return the variables that values of `env:` name, and that nothing gives a value."""
    names = (name for text in _texts_in(dataflow) for name in _names_in(text, with_default=False))
    return [name for name in dict.fromkeys(names) if name not in environment]


def _until_daemon(text: str) -> str:
    return _UNTIL_DAEMON % text if is_infinite(text) else text


def _texts_in(dataflow: Dataflow) -> Iterator[str]:
    for env in (dataflow.env, *(node.env for node in dataflow.nodes)):
        yield from (value for value in env.values() if isinstance(value, str))


def _names_in(text: str, with_default: bool = True) -> Iterator[str]:
    whole, rest = _parts(text)
    for match in (*re.finditer(_REFERENCE, whole), *re.finditer(_SHORT, rest)):
        found = match.groupdict()
        name = found["plain"] or found.get("name")
        if name and (with_default or found.get("default") is None):
            yield name


def _parts(text: str) -> tuple[str, str]:
    """Split a text after its last "}": in the rest, "${" has no end."""
    head, brace, rest = text.rpartition("}")
    return head + brace, rest
