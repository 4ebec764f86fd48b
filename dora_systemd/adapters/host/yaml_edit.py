"""Changes one value in the text of a YAML file, and leaves comments, order and style as they are.

PyYAML knows at which line and column each node begins and ends. Where a value can be changed, added
or not is decided by these marks only; the caller parses the new text, and compares.
"""

from collections.abc import Sequence
from typing import Any

import yaml

from dora_systemd.adapters.host.yaml_loader import Loader

_INDENT = 2
_ITEM = "output"
"""The key by which an item of a list is found."""


def with_value(text: str, keys: Sequence[str], value: str) -> str | None:
    """The text with `value` at `keys`; None if the text there has a form that is not for this.

    text: what parse_yaml() has accepted. value: a plain scalar. In a list, a key is that of the
    item whose `output` it is.
    """
    node, left, parent = yaml.compose(text, Loader=Loader), list(keys), None
    while left and (found := _child(node, left[0])) is not None:
        parent, node = node, found
        left.pop(0)
    lines = text.splitlines(keepends=True)
    if not left:
        return _replaced(lines, node, value)
    if isinstance(node, yaml.MappingNode):
        return _added(lines, node, left, value)
    if node is None and not text.strip():
        return "".join(_nested(left, value, 0))
    if node is None or _is_empty(node):
        return _filled(lines, node, parent, keys[: len(keys) - len(left)], left, value)
    return None


def _child(node: Any, key: str) -> Any:
    if isinstance(node, yaml.MappingNode):
        return next((value for name, value in node.value if name.value == key), None)
    if isinstance(node, yaml.SequenceNode):
        items = ((item, _child(item, _ITEM)) for item in node.value)
        return next((item for item, name in items if name is not None and name.value == key), None)
    return None


def _is_empty(node: Any) -> bool:
    """Whether it is a key with nothing behind it."""
    return isinstance(node, yaml.ScalarNode) and node.value == "" and not node.style


def _replaced(lines: list[str], node: Any, value: str) -> str | None:
    start, end = node.start_mark, node.end_mark
    is_plain = isinstance(node, yaml.ScalarNode) and node.style not in ("|", ">")
    if not is_plain or start.line != end.line or _is_empty(node):
        return None
    line = lines[start.line]
    lines[start.line] = f"{line[: start.column]}{value}{line[end.column :]}"
    return "".join(lines)


def _added(lines: list[str], node: Any, keys: Sequence[str], value: str) -> str | None:
    if node.flow_style:
        return _added_in_braces(lines, node, keys, value)
    first = node.value[0][0].start_mark
    if lines[first.line][: first.column].strip(" -"):
        return None  # the key does not begin its line
    return _inserted(lines, _last_line(node), _nested(keys, value, first.column))


def _added_in_braces(lines: list[str], node: Any, keys: Sequence[str], value: str) -> str:
    end = node.end_mark
    inner = value
    for key in reversed(keys[1:]):
        inner = f"{{{key}: {inner}}}"
    line, brace = lines[end.line], end.column - 1
    before = line[:brace].rstrip()
    space = " " if line[:brace] != before and before.strip() else ""
    comma = ("" if before.endswith(",") else ",") + " " if node.value else ""
    lines[end.line] = f"{before}{comma}{keys[0]}: {inner}{space}{line[brace:]}"
    return "".join(lines)


def _filled(
    lines: list[str], node: Any, parent: Any, done: Sequence[str], keys: Sequence[str], value: str
) -> str | None:
    """Write below a key that has nothing behind it, or into a file that has only comments."""
    if node is None or parent is None:
        return _inserted(lines, len(lines) - 1, _nested(keys, value, 0))
    if parent.flow_style:
        return None
    key = next(name for name, _ in parent.value if name.value == done[-1])
    indented = _nested(keys, value, key.start_mark.column + _INDENT)
    return _inserted(lines, key.start_mark.line, indented)


def _nested(keys: Sequence[str], value: str, column: int) -> list[str]:
    """The lines of a value below its keys."""
    *above, last = keys
    lines = [f"{' ' * (column + _INDENT * n)}{key}:\n" for n, key in enumerate(above)]
    return [*lines, f"{' ' * (column + _INDENT * len(above))}{last}: {value}\n"]


def _inserted(lines: list[str], at: int, new: Sequence[str]) -> str:
    """The lines with new ones behind the line `at`."""
    if lines and not lines[at].endswith("\n"):
        lines[at] += "\n"
    end = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
    added = [line.replace("\n", end) for line in new]
    return "".join([*lines[: at + 1], *added, *lines[at + 1 :]])


def _last_line(node: Any) -> int:
    """The last line of a value; the end mark of a block is where the next token begins."""
    if isinstance(node, yaml.ScalarNode):
        is_block = node.style in ("|", ">") and node.end_mark.column == 0
        end: int = node.end_mark.line
        return end - int(is_block)
    if node.flow_style or not node.value:
        return int(node.end_mark.line)
    last = node.value[-1]
    if isinstance(node, yaml.SequenceNode):
        return _last_line(last)
    key, value = last
    return max(int(key.end_mark.line), _last_line(value))
