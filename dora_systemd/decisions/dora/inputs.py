"""Names the input that dora means when it only says that none of its forms fits. Pure."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from dora_systemd.values import quoted, shown

UNNAMED = re.compile(r"nodes\[(\d+)\]\.inputs: data did not match any variant of untagged enum \w+")
_SOURCE = re.compile(r"[^/]+/.+")
_TIMER = re.compile(r"dora/timer/(?:millis|secs|hz)/[0-9]+")
_LONGEST = 60
_NUMBERS = ("queue_size", "input_timeout")


def name_input(reason: str, document: Any) -> str:
    """An error of dora with the input and its value, as far as they can be told.

    document: the dataflow file.
    """
    match = UNNAMED.search(reason)
    if match is None:
        return reason
    inputs = _inputs(document, int(match[1]))
    found = [
        f"{shown(str(key)[:_LONGEST])}: {trouble}"
        for key, value in inputs.items()
        if (trouble := _trouble_of(value))
    ]
    told = found[0] if found else "it is not NODE/OUTPUT, a timer, or a mapping with a source"
    place = f"nodes[{match[1]}].inputs{'.' if found else ': '}"
    return f"{reason[: match.start()]}{place}{told}{reason[match.end() :]}"


def _inputs(document: Any, place: int) -> Mapping[Any, Any]:
    nodes = document.get("nodes") if isinstance(document, Mapping) else None
    node = nodes[place] if isinstance(nodes, list) and place < len(nodes) else None
    inputs = node.get("inputs") if isinstance(node, Mapping) else None
    return inputs if isinstance(inputs, Mapping) else {}


def _trouble_of(value: Any) -> str:
    """Why dora cannot read the value of an input, or ""."""
    return next(_troubles(value), "")


def _troubles(value: Any) -> Iterator[str]:
    source = value.get("source") if isinstance(value, Mapping) else value
    if not isinstance(source, str):
        yield "it has no source, such as NODE/OUTPUT"
    elif source.startswith("dora/timer") and not _TIMER.fullmatch(source):
        yield f"{quoted(source)} is not a timer such as dora/timer/millis/50"
    elif not _SOURCE.fullmatch(source):
        yield f"{quoted(source)} is not NODE/OUTPUT"
    for key in _NUMBERS if isinstance(value, Mapping) else ():
        number = value.get(key, 0)
        if isinstance(number, bool) or not isinstance(number, int | float):
            yield f"{key} is {quoted(str(number))}, and not a number"
