"""The schema of settings files, from the table of settings. Only this module imports pydantic."""

from collections.abc import Container, Mapping, Sequence
from functools import reduce
from itertools import dropwhile, islice
from operator import or_
from types import UnionType
from typing import Any, get_args, get_origin

from pydantic import (
    VERSION,
    BaseModel,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
    ValidationError,
    create_model,
)

from dora_systemd.decisions.descriptor.json_size import refusal
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.nodes import NODES
from dora_systemd.errors import DoraSystemdError, WrongKey
from dora_systemd.names import did_you_mean
from dora_systemd.values import as_mapping, quoted, shown

# strict: pydantic must not convert between lists, texts and booleans; the kinds parse texts.
# Debian 12 and Ubuntu 24.04 have pydantic 1.10, which has strict types but no strict models.
_IS_OLD = VERSION.startswith("1.")
_WORDS: dict[str, Any] = {"extra": "forbid", "strict": True}
_CONFIG: Any = type("Config", (), _WORDS) if _IS_OLD else _WORDS
_STRICT = {str: StrictStr, int: StrictInt, float: StrictFloat, bool: StrictBool}
_UNKNOWN = ("extra_forbidden", "value_error.extra")


def validate_settings(document: object, table: Sequence[Setting[Any]]) -> None:
    """Raise ValueError, for validation_error(), if `document` is not a settings file of `table`."""
    model = settings_model(table, _keys_of(document))
    if _IS_OLD:
        model.parse_obj(_no_mapping(document))
    else:
        model.model_validate(document)


def _keys_of(document: object) -> set[object]:
    """The keys of the dataflow and of its nodes."""
    keys = as_mapping(document)
    nodes = as_mapping(keys.get(NODES)).values()
    return {*keys, *(key for node in nodes for key in as_mapping(node))}


def settings_model(table: Sequence[Setting[Any]], keys: Container[object]) -> type[BaseModel]:
    """The model of a settings file: every key is optional, unknown keys are errors.

    keys: of the file. A model of all settings takes a seventh of the CPU time of a start.
    """
    known = [one for one in table if one.name in keys]
    fields = _fields([one for one in known if not one.only_nodes and one.name != NODES])
    if any(one.per_node for one in table):
        of_nodes = _fields([one for one in known if one.per_node])
        node = create_model("NodeSettings", __config__=_CONFIG, **of_nodes)
        fields[NODES] = (dict[str, node | None] | None, None)  # type: ignore[valid-type]
    model: type[BaseModel] = create_model("SettingsFile", __config__=_CONFIG, **fields)
    return model


_OF_TEXTS = ("env", "property", "credentials")
"""Settings that are mappings with any keys."""


def validation_error(
    source: str, error: ValueError, table: Sequence[Setting[Any]]
) -> DoraSystemdError:
    """The first error that pydantic found in the file `source`, in one line."""
    if not isinstance(error, ValidationError):
        return refusal(source, "it is not a settings file", str(error))
    first = error.errors()[0]
    place = [str(part) for part in first["loc"]]
    settings = {setting.name: setting for setting in table}
    if first["type"] in _UNKNOWN:
        near = did_you_mean(place[-1], _known(place, table))
        hint = _other_place(place, settings) or near or "dora-systemd.yml(5) lists the keys"
        owner = f" of node {quoted(place[1])}" if len(place) > 2 and place[0] == "nodes" else ""
        reason = f"unknown key {quoted(place[-1])}{owner}"
    else:
        key = next((part for part in reversed(place) if part in settings), place[0])
        expected = settings[key].kind.expected if key in settings else "a mapping"
        hint = f"write {expected}"
        if key in _OF_TEXTS and (entry := _entry(place)):
            place, key, hint = [key, entry], f"{key}.{shown(entry)}", "write it as text, in quotes"
        reason = f"the value of {key} is of another type"
    refused = refusal(source, reason, hint)
    return WrongKey(refused.message, refused.hint, source, place)


def _other_place(place: Sequence[str], settings: Mapping[str, Setting[Any]]) -> str:
    """Where a key belongs that is only for nodes, or only for the dataflow; "" for other keys."""
    setting = settings.get(place[-1])
    if setting is None:
        return ""
    return f"write {setting.name} {'below' if setting.only_nodes else 'outside of'} nodes:"


def _entry(place: Sequence[str]) -> str:
    """The key of a wrong value inside a mapping such as env; "" if the mapping itself is none."""
    inside = dropwhile(lambda part: not part.startswith("dict["), place)
    return next(islice(inside, 1, None), "")


def _fields(table: Sequence[Setting[Any]]) -> dict[str, Any]:
    return {setting.name: (_strict(setting.kind.schema) | None, None) for setting in table}


class _List(list[Any]):
    keys = None


class _Text(str):
    keys = None


def _no_mapping(value: Any) -> Any:
    """The value with lists and texts that pydantic 1.10 cannot pass to dict(), as it tries to."""
    if isinstance(value, Mapping):
        return {key: _no_mapping(one) for key, one in value.items()}
    if isinstance(value, list):
        return _List(map(_no_mapping, value))
    return _Text(value) if isinstance(value, str) else value


def _strict(schema: Any) -> Any:
    """The type `schema` without conversions, for either version of pydantic."""
    inner = [_strict(one) for one in get_args(schema)]
    if not inner:
        return _STRICT.get(schema, schema)
    return reduce(or_, inner) if isinstance(schema, UnionType) else get_origin(schema)[*inner]


def _known(place: Sequence[str], table: Sequence[Setting[Any]]) -> list[str]:
    inside_node = len(place) > 1
    return [one.name for one in table if (one.per_node if inside_node else not one.only_nodes)]
