"""Extracts the reason from dora's error output, and names the input that it is about. Pure."""

import re
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

from dora_systemd.names import did_you_mean
from dora_systemd.terminal_text import short_line, without_sequences
from dora_systemd.values import as_list, as_mapping, quoted, shown

_NUMBERED = r"\d+: +"
_OS_ERROR = r"\(os error \d+\)$"
_END = ("Location:", "Stack backtrace:", "Backtrace omitted", "Run with ")
_CHOICES = r"`([^`]*)`, expected one of ((?:`[^`]*`(?:, )?){6,})"
_BAD_VALUE = r"data did not match any variant of untagged enum EnvValue"
UNSET = "a value names a variable that is not set"
UNSET_OR_OTHER = f"{UNSET} (see --env), or is a list or mapping"
_MAX_LENGTH = 300


def parse_dora_error(stderr: str) -> str:
    """The reason in dora's error output on one line: the innermost cause.

    dora (eyre) prints a headline after "[ERROR]", hints, "Caused by:" with one cause or numbered
    causes, then its source location and sometimes a backtrace. Without causes the reason is the
    headline, or the line about a wrong command line, or the last line; "" without any output.
    """
    lines = [line.strip() for line in without_sequences(stderr).splitlines()]
    headline = _after(lines, "[ERROR]")[:1]
    usage = [line for line in lines if line.startswith("error: ")][:1]
    last = [line for line in lines if line][-1:]
    reason = _innermost(_after(lines, "Caused by:")) or " ".join(headline or usage or last)
    return short_line(
        re.sub(_BAD_VALUE, UNSET_OR_OTHER, re.sub(_CHOICES, _nearest, reason)), _MAX_LENGTH
    )


def _nearest(choices: re.Match[str]) -> str:
    """Return the written value with the nearest of many choices."""
    near = did_you_mean(choices[1], re.findall("`([^`]*)`", choices[2]))
    return f"`{choices[1]}`" + (f" ({near})" if near else "")


def _after(lines: list[str], mark: str) -> list[str]:
    """The lines after `mark` up to the end of that paragraph; [] without `mark`."""
    if mark not in lines:
        return []
    block: list[str] = []
    for line in lines[lines.index(mark) + 1 :]:
        if line.startswith(_END) or (block and not line):
            break
        block += [line] * bool(line)
    return block


def _innermost(causes: list[str]) -> str:
    """The last numbered cause with its continuation lines, or the whole of an unnumbered one.

    An error of the operating system does not name its object: the cause before it does.
    """
    starts = [place for place, line in enumerate(causes) if re.match(_NUMBERED, line)]
    blocks = [" ".join(causes[begin:end]) for begin, end in pairwise([*starts, len(causes)])]
    reasons = [re.sub(_NUMBERED, "", block, count=1) for block in blocks] or [" ".join(causes)]
    return ": ".join(reasons[-2:]) if re.search(_OS_ERROR, reasons[-1]) else reasons[-1]


UNNAMED = r"nodes\[(\d+)\]\.inputs: data did not match any variant of untagged enum \w+"
_SOURCE = r"[^/]+/.+"
_TIMER = r"dora/timer/(?:millis|secs|hz)/[0-9]+"
_LONGEST = 60
_NUMBERS = ("queue_size", "input_timeout")


def name_input(reason: str, document: Any) -> str:
    """Return an error of dora with the name and the value of the bad input, if they can be found.

    document: the dataflow file.
    """
    match = re.search(UNNAMED, reason)
    if match is None:
        return reason
    inputs = _inputs(document, int(match[1]))
    found = [
        f"{shown(str(key)[:_LONGEST])}: {trouble}"
        for key, value in inputs.items()
        if (trouble := next(_troubles(value), ""))
    ]
    told = found[0] if found else "it is not NODE/OUTPUT, a timer, or a mapping with a source"
    place = f"nodes[{match[1]}].inputs{'.' if found else ': '}"
    return f"{reason[: match.start()]}{place}{told}{reason[match.end() :]}"


def _inputs(document: Any, place: int) -> Mapping[Any, Any]:
    nodes = as_list(as_mapping(document).get("nodes"))
    return as_mapping(as_mapping(nodes[place]).get("inputs")) if place < len(nodes) else {}


def _troubles(value: Any) -> Iterator[str]:
    source = value.get("source") if isinstance(value, Mapping) else value
    if not isinstance(source, str):
        yield "it has no source, such as NODE/OUTPUT"
    elif source.startswith("dora/timer") and not re.fullmatch(_TIMER, source):
        yield f"{quoted(source)} is not a timer such as dora/timer/millis/50"
    elif not re.fullmatch(_SOURCE, source):
        yield f"{quoted(source)} is not NODE/OUTPUT"
    for key in _NUMBERS if isinstance(value, Mapping) else ():
        number = value.get(key, 0)
        if isinstance(number, bool) or not isinstance(number, int | float):
            yield f"{key} is {quoted(str(number))}, and not a number"
