"""The nodes of a descriptor, and the words of `args:`; dataflow.py has the whole descriptor."""

import re
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from dora_systemd.decisions.descriptor.json_size import refusal
from dora_systemd.names import MAX_NODE_ID, NODE_ID, did_you_mean
from dora_systemd.values import as_mapping, quoted, scalar_text

_RESERVED_IDS = frozenset({"dora"})
_OUTPUT_KEYS = ("send_stdout_as", "send_logs_as", "min_log_level")
"""Keys for what dora's daemon does with what it reads of a node's stdout and stderr."""
_BACKOFF_KEYS = ("max_restarts", "restart_delay", "max_restart_delay", "restart_window")


class NodeKind(StrEnum):
    """What dora starts for a node; the names are those of the live table."""

    PYTHON = "python"
    EXECUTABLE = "executable"
    SHELL = "shell"
    DYNAMIC = "dynamic"
    URL = "url"
    OPERATOR = "operator"
    ROS2 = "ros2"
    MODULE = "module"
    HUB = "hub"


_KEY_KINDS = {
    "operator": NodeKind.OPERATOR,
    "operators": NodeKind.OPERATOR,
    "ros2": NodeKind.ROS2,
    "module": NodeKind.MODULE,
    "hub": NodeKind.HUB,
}
_PATH_KINDS = {"dynamic": NodeKind.DYNAMIC, "shell": NodeKind.SHELL}
UNEXPANDED = frozenset({NodeKind.MODULE, NodeKind.HUB})
"""Kinds that `dora expand` replaces: their outputs are declared elsewhere."""


class Input(NamedTuple):
    """One input: its name in errors, and its source: NODE/OUTPUT or one of dora's own."""

    name: str
    source: str


class Node(NamedTuple):
    """One node of a descriptor."""

    id: str
    kind: NodeKind
    # path, args: as written, or ""
    path: str
    args: str
    env: Mapping[str, object]  # its own variables, with values as in YAML
    # inputs, outputs: including those of its operators; with several operators as "operator/output"
    inputs: tuple[Input, ...]
    outputs: frozenset[str]
    restart_policy: str  # "never", "on-failure" or "always"; "" if the descriptor has none
    backoff: Mapping[str, object]  # the other restart keys that are set, such as restart_delay
    # build, git: the command and the repository for `dora build`, or ""
    build: str
    git: str
    # whether dora must read its output: for outputs made of it (`send_stdout_as`, `send_logs_as`),
    # for `min_log_level`, and for an input from `dora/logs`
    keeps_output: bool
    working_directory: str  # of `deploy:`, or ""
    raw: Mapping[str, object]  # the complete mapping


def parse_node(node: object, place: int, source: str) -> Node:
    """The node at index `place` of the list; raises as parse_dataflow does."""
    if not isinstance(node, dict):
        hint = "a node is a mapping with at least 'id' and 'path'"
        raise refusal(source, f"node {place + 1} is {described(node)}", hint)
    node_id = _parse_id(node.get("id"), place, source)
    what = f"node {node_id}"
    return Node(
        id=node_id,
        kind=_kind_of(node, source, what),
        path=text_of(node.get("path")),
        args=text_of(node.get("args")),
        env=mapping_of(node.get("env"), source, f"{what}: 'env'"),
        inputs=tuple(_inputs(node, source, what)),
        outputs=frozenset(_outputs(node, source, what)),
        restart_policy=text_of(node.get("restart_policy")),
        backoff={key: node[key] for key in _BACKOFF_KEYS if node.get(key) is not None},
        build=text_of(node.get("build")),
        git=text_of(node.get("git")),
        keeps_output=any(
            part.get(key) is not None
            for _, part in _operators(node, source, what)
            for key in _OUTPUT_KEYS
        ),
        working_directory=text_of(mapping_of(node.get("deploy"), source, what).get("working_dir")),
        raw=node,
    )


def _parse_id(node_id: object, place: int, source: str) -> str:
    what = f"node {place + 1}"
    if node_id is None:
        raise refusal(source, f"{what} has no id", "give every node an 'id'")
    if not isinstance(node_id, str):
        hint = f'in quotes it is text: id: "{node_id}"'
        raise refusal(source, f"the id of {what} is {described(node_id)}", hint)
    hint = ""
    if not re.fullmatch(NODE_ID, node_id):
        hint = "an id is letters, digits, '_', '-' and '.', and begins with no '.'"
    elif node_id in _RESERVED_IDS:
        hint = "'dora' stands for dora's own sources, such as dora/timer"
    elif len(node_id) > MAX_NODE_ID:
        hint = f"an id has at most {MAX_NODE_ID} characters: it names a cgroup"
    if hint:
        raise refusal(source, f"{what} has the id {quoted(node_id)}", hint)
    return node_id


def _kind_of(node: Mapping[str, object], source: str, what: str) -> NodeKind:
    for key, kind in _KEY_KINDS.items():
        if node.get(key) is not None:
            return kind
    path = text_of(node.get("path"))
    if not path:
        kinds = ("path", *_KEY_KINDS)
        near = (did_you_mean(key, kinds) for key in node if key not in kinds)
        hint = "a node needs one of path, operator, operators, ros2, module and hub"
        raise refusal(source, f"{what} has no path", next(filter(None, near), hint))
    if path in _PATH_KINDS:
        return _PATH_KINDS[path]
    if path.startswith(("http://", "https://")):
        return NodeKind.URL
    return NodeKind.PYTHON if path.endswith(".py") else NodeKind.EXECUTABLE


def _operators(
    node: Mapping[str, object], source: str, what: str
) -> Iterator[tuple[str, Mapping[str, object]]]:
    """The parts of a node that have inputs and outputs, with the prefix of their names."""
    yield "", node
    yield "", mapping_of(node.get("operator"), source, f"{what}: 'operator'")
    for operator in _sequence(node.get("operators"), source, f"{what}: 'operators'"):
        part = mapping_of(operator, source, f"{what}: an operator")
        yield f"{text_of(part.get('id'))}/", part


def operator_file(operator: object) -> object:
    """The `python` of an operator, which is a file or a mapping with one."""
    python = as_mapping(operator).get("python")
    return python.get("source") if isinstance(python, dict) else python


def _inputs(node: Mapping[str, object], source: str, what: str) -> Iterator[Input]:
    for prefix, part in _operators(node, source, what):
        inputs = mapping_of(part.get("inputs"), source, f"{what}: 'inputs'")
        for name, value in inputs.items():
            origin = value.get("source") if isinstance(value, dict) else value
            yield Input(prefix + name, text_of(origin))


def _outputs(node: Mapping[str, object], source: str, what: str) -> Iterator[str]:
    for prefix, part in _operators(node, source, what):
        for output in _sequence(part.get("outputs"), source, f"{what}: 'outputs'"):
            yield prefix + text_of(output)


def text_of(value: object) -> str:
    """Text as dora reads it: dora accepts numbers and booleans as text."""
    return "" if value is None or isinstance(value, dict | list) else scalar_text(value)


def mapping_of(value: object, source: str, what: str) -> Mapping[str, object]:
    """A mapping, empty if nothing is written; raises for anything else.

    what: its name in the error.
    """
    if value is not None and not isinstance(value, dict):
        raise refusal(source, f"{what} is {described(value)}", "write a mapping, KEY: VALUE")
    return value or {}


def _sequence(value: object, source: str, what: str) -> Sequence[object]:
    if value is not None and not isinstance(value, list):
        raise refusal(source, f"{what} is {described(value)}", "write a list")
    return value or ()


def described(value: object) -> str:
    """The type of `value` in the terms of YAML."""
    if isinstance(value, str):
        return f"the text {quoted(value)}"
    words = {dict: "a mapping", list: "a list", bool: "true or false", type(None): "nothing"}
    return words.get(type(value), "a number")


_BLANKS = " \t\n"
_GAP = r"(?:[ \t\n]|#[^\n]*)*"
"""Between words. A "#" that begins a word begins a comment."""
_PIECE = (
    r"""(?s)'(?P<literal>[^']*)'|"(?P<quoted>(?:[^"\\]|\\.)*)"|"""
    r"""\\(?P<one>.)|(?P<plain>[^ \t\n'"\\]+)"""
)
_ESCAPE = r'\\(?:\n|([$`"\\]))'
"""Escapes in double quotes; before any other character a backslash is literal."""


def split_arguments(text: str) -> list[str]:
    """Split `args:` of a node into words as dora's daemon does, by the rules of Rust's crate shlex.

    Python's shlex differs: there "#" begins no comment, a carriage return separates words, a
    backslash before a newline keeps the newline, and in double quotes it also escapes nothing but
    '"' and itself. Raises ValueError for an open quote and for a backslash at the end.
    """
    words = []
    place = _end_of_gap(text, 0)
    while place < len(text):
        word, place = _next_word(text, place)
        words.append(word)
        place = _end_of_gap(text, place)
    return words


def _end_of_gap(text: str, place: int) -> int:
    match = re.compile(_GAP).match(text, place)
    return match.end() if match else place


def _next_word(text: str, place: int) -> tuple[str, int]:
    """The word that begins at `place`, and where it ends."""
    word = ""
    while place < len(text) and text[place] not in _BLANKS:
        piece = re.compile(_PIECE).match(text, place)
        if piece is None:
            raise ValueError("a backslash ends it" if text[place] == "\\" else "a quote is open")
        word += _value(piece)
        place = piece.end()
    return word, place


def _value(piece: re.Match[str]) -> str:
    text = piece[0] if piece.lastgroup is None else piece[piece.lastgroup]
    if piece.lastgroup == "quoted":
        return re.sub(_ESCAPE, lambda match: match[1] or "", text)
    return "" if piece.lastgroup == "one" and text == "\n" else text
