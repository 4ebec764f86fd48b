"""The setting `nodes`: settings of single nodes.

A settings file has `nodes: NODE: KEY: VALUE`, the command line `--node NODE:KEY=VALUE,KEY=VALUE`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from dora_systemd.decisions.settings.kinds import Base, Kind, Setting, texts_of
from dora_systemd.errors import DoraSystemdError, WrongKey, usage_error
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted

NODES = "nodes"
Nodes = Mapping[str, Mapping[str, Any]]
"""Values by node and by name of the setting."""
_Known = Mapping[str, Setting[Any]]
_MANY = 12
"""More keys than a hint has."""


def nodes_setting(table: Iterable[Setting[Any]]) -> Setting[Nodes]:
    """The setting for those of `table` that nodes can have."""
    known = {one.name: one for one in table if one.per_node}
    kind = Kind[Nodes](
        dict,
        "a mapping, NODE: {KEY: VALUE}",
        lambda value, base: _parse(value, base, known),
        lambda nodes: list(_texts(nodes, known)),
        is_repeatable=True,
        merge=_merge,
        metavar="NODE:KEY=VALUE,...",
    )
    what = "Settings of one node, by the keys of a settings file, see dora-systemd.yml(5)."
    return Setting(NODES, kind, {}, what, flags=("--node",))


def _parse(value: Any, base: Base, known: _Known) -> Nodes:
    given = value if isinstance(value, Mapping) else _from_texts(texts_of(value), known)
    found = {
        node: {
            key: _parsed(known[key], one, base, node)
            for key, one in (values or {}).items()
            if one is not None
        }
        for node, values in given.items()
    }
    return {node: values for node, values in found.items() if values}


def _parsed(setting: Setting[Any], value: Any, base: Base, node: str) -> Any:
    try:
        return setting.of_node().parse(value, base)
    except DoraSystemdError as error:
        raise WrongKey(error.message, error.hint, "", (node, setting.name)) from error


def _from_texts(texts: Iterable[str], known: _Known) -> dict[str, dict[str, Any]]:
    """The values as a settings file has them; of several the last one counts, or all are a list."""
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        node, _, assignments = text.partition(":")  # node ids have no colon
        if not node or not assignments:
            hint = "write NODE:KEY=VALUE,KEY=VALUE, such as camera:memory_limit=1G,cpu_limit=1.5"
            raise usage_error(f"cannot use {quoted(text)} as settings of a node", hint)
        values = found.setdefault(node, {})
        for key, value in _assignments(node, assignments, known):
            is_list = known[key].of_node().is_repeatable
            values[key] = [*values.get(key, ()), value] if is_list else value
    return found


def _assignments(node: str, text: str, known: _Known) -> Iterator[Sequence[str]]:
    """Pairs of a key and its text. A comma without a key after it is part of a value."""
    found: list[list[str]] = []
    for part in text.split(","):
        key, equals, value = part.partition("=")
        inner = known[found[-1][0]].of_node().keys if found else ()
        is_key = equals and key.isidentifier()
        if found and (not is_key or key in inner):
            found[-1][1] += f",{part}"
        elif is_key and key in known:
            found.append([key, value])
        else:
            what = f"{quoted(part)} as a setting of the node {quoted(node)}"
            raise usage_error(f"cannot use {what}", _hint(key, (*known, *inner)))
    yield from found


def _hint(key: str, known: Sequence[str]) -> str:
    if key in known:
        return f"write {key}=VALUE"
    if len(known) > _MANY:
        return did_you_mean(key, known) or "dora-systemd.yml(5) lists the keys"
    return did_you_mean(key, known) or f"valid keys: {', '.join(known)}"


def _texts(nodes: Nodes, known: _Known) -> Iterator[str]:
    for node, values in nodes.items():
        for key, value in values.items():
            yield from (f"{node}:{key}={text}" for text in known[key].of_node().format(value))


def _merge(lower: Nodes, higher: Nodes) -> Nodes:
    return {
        node: {**lower.get(node, {}), **higher.get(node, {})}
        for node in dict.fromkeys((*lower, *higher))
    }
