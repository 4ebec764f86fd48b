"""Reads YAML as dora does. Only `files` imports it, and only when there is YAML to read.

PyYAML follows YAML 1.1, where `on` is true, `010` is 8, `1:30` is 90 and `2024-01-01` a date.
dora's parser follows the core schema of YAML 1.2 (chapter 10.3). This loader does too; else nodes
would get other values from us than from dora.
"""

import re
from collections.abc import Hashable
from typing import Any

import yaml

_BASE: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TAG = "tag:yaml.org,2002:"
_BASES = {"0x": 16, "0o": 8, "0b": 2}
_CORE = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+|0b[01]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
)
_TEXT_KEYS = {
    *("id", "name", "description", "path", "path_sha256", "args", "build", "git", "branch", "tag"),
    *("rev", "send_stdout_as", "send_logs_as", "min_log_level", "max_log_size"),
}
"""Keys of a node that dora reads as text, whatever it looks like: `args: 1.50` is "1.50"."""


class Loader(_BASE):  # type: ignore[misc]
    """The core schema, without merge keys and without repeated keys in a mapping."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def get_single_node(self) -> Any:
        """The document; in a list `nodes`, plain numbers and booleans stay text where dora does."""
        document = super().get_single_node()
        for node in _items(_values(document).get("nodes")):
            values = _values(node)
            if (
                isinstance(ident := values.get("id"), yaml.ScalarNode)
                and ident.value.lower() == "null"
            ):
                ident.tag = f"{_TAG}str"  # the only text that a node must have: not null for dora
            outputs = _items(values.get("outputs"))
            for text in (*(values[key] for key in _TEXT_KEYS & values.keys()), *outputs):
                if isinstance(text, yaml.ScalarNode) and text.tag != f"{_TAG}null":
                    text.tag = f"{_TAG}str"
        return document

    def flatten_mapping(self, node: Any) -> None:
        """Do nothing: dora has no `<<`, and nested merges would grow without limit."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        """The mapping of `node`; raises a ConstructorError with the line of a repeated key."""
        seen: set[Hashable] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                problem = f"duplicate key {key_node.value!r}"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            seen |= {key} if isinstance(key, Hashable) else set()
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def _values(node: Any) -> dict[str, Any]:
    """The values of a mapping by plain key; none for any other node."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else ()
    return {key.value: value for key, value in pairs if isinstance(key, yaml.ScalarNode)}


def _items(node: Any) -> list[Any]:
    return node.value if isinstance(node, yaml.SequenceNode) else []


def _integer(loader: Any, node: Any) -> int:
    text = loader.construct_scalar(node)
    base = _BASES.get(text[:2])
    return int(text[2:], base) if base else int(text)


def _boolean(loader: Any, node: Any) -> bool:
    return bool(loader.construct_scalar(node).lower() == "true")


for _tag, _pattern, _first in _CORE:
    Loader.add_implicit_resolver(_TAG + _tag, re.compile(f"(?:{_pattern})$"), _first)
Loader.add_constructor(_TAG + "int", _integer)
Loader.add_constructor(_TAG + "bool", _boolean)
