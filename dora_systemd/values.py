"""Parses and formats sizes, durations, CPU shares and booleans as systemd does.

Every `parse_` function raises DoraSystemdError (ExitCode.USAGE) for unknown text. The message has
the text, and the hint has what was expected: a caller that knows the key or file can make its own
message, and keep the hint.
"""

import re
import shlex
import time
from collections.abc import Iterable
from typing import Any

from dora_systemd.errors import DoraSystemdError, usage_error

INFINITY = 2**64 - 1
""""infinity" on D-Bus, "max" in cgroup files: UINT64_MAX, for sizes, durations and CPU shares."""

SECOND = 1_000_000
"""Microseconds per second."""

_SIZE = r"([0-9]+)(?:\.([0-9]+))?\s*([KMGTPE]?)B?"
_SIZE_FACTORS = {suffix: 1024**power for power, suffix in enumerate(" KMGTPE") if power} | {"": 1}
_SIZE_HINT = "write bytes, or a number with K, M, G or T (powers of 1024) such as 512M; or infinity"

_MINUTE, _HOUR, _DAY = 60 * SECOND, 3600 * SECOND, 86400 * SECOND
_DURATION_UNITS = {
    **dict.fromkeys(("usec", "us", "µs", "μs"), 1),
    **dict.fromkeys(("msec", "ms"), 1000),
    **dict.fromkeys(("seconds", "second", "sec", "s", ""), SECOND),
    **dict.fromkeys(("minutes", "minute", "min", "m"), _MINUTE),
    **dict.fromkeys(("hours", "hour", "hr", "h"), _HOUR),
    **dict.fromkeys(("days", "day", "d"), _DAY),
    **dict.fromkeys(("weeks", "week", "w"), 7 * _DAY),
    **dict.fromkeys(("months", "month", "M"), 2_629_800 * SECOND),
    **dict.fromkeys(("years", "year", "y"), 31_557_600 * SECOND),
}
_DURATION_NAMES = (("d", _DAY), ("h", _HOUR), ("min", _MINUTE), ("s", SECOND), ("ms", 1000))
_SPAN = r"\s*([0-9]+)(?:\.([0-9]+))?\s*([a-zA-Zµμ]*)"
_DURATION_HINT = "write seconds, or a time span such as 500ms, 10s or 1min 30s; or infinity"

_CPU = r"([0-9]+)(?:\.([0-9]+))?(%?)"
_CPU_STEP = 100
_CPU_HINT = "write cores such as 1.5, or a share of one core such as 150%; or infinity"

_BOOLEANS = {
    **dict.fromkeys(("1", "yes", "y", "true", "t", "on"), True),
    **dict.fromkeys(("0", "no", "n", "false", "f", "off"), False),
}

# Longer numbers exceed 64 bits, and Python refuses to convert very long ones.
_MAX_DIGITS = 40
_MAX_SHOWN = 60


def quoted(text: str) -> str:
    """`text` for a message: quoted, on one line, escaped, and cut at 60 characters."""
    cut = text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."
    return repr(cut)


def shown(text: str) -> str:
    """`text` for a message, with quotes only if necessary: for paths and file names."""
    return text if text.isprintable() and text.strip() == text and text else quoted(text)


def shell_word(text: str) -> str:
    """`text` as one word of a command that a hint names: a path may contain a command, too."""
    return shlex.quote(text if text.isprintable() else shown(text))


def counted(count: int, what: str) -> str:
    """Format a number of things, as in "1 node" and "2 nodes"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def scalar_text(value: object) -> str:
    """A YAML scalar as the author and dora see it: true, 1, 0.5, text."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def parse_size(text: str) -> int:
    """Bytes; K, M, G, T, P and E are powers of 1024 as in systemd.resource-control(5)."""
    if text.strip() == "infinity":
        return INFINITY
    match = re.fullmatch(_SIZE, text.strip())
    size = _scaled(match[1], match[2], _SIZE_FACTORS[match[3]]) if match else None
    if size is None:
        raise _refusal("size", text, _SIZE_HINT)
    return size


def format_size(size: int) -> str:
    """The shortest exact text of `size` bytes; parse_size returns the same number."""
    if size == INFINITY:
        return "infinity"
    for suffix in "EPTGMK":
        if size and size % _SIZE_FACTORS[suffix] == 0:
            return f"{size // _SIZE_FACTORS[suffix]}{suffix}"
    return str(size)


def format_rounded_size(size: int) -> str:
    """`size` bytes for a table: three digits and a letter, such as 256M or 1.5G."""
    if size == INFINITY:
        return "infinity"
    for suffix in "EPTGMK":
        amount = size / _SIZE_FACTORS[suffix]
        if amount >= 1:
            digits = f"{amount:.1f}" if amount < 9.95 else f"{amount:.0f}"
            return digits.removesuffix(".0") + suffix
    return f"{size}B"


def parse_duration(text: str) -> int:
    """Microseconds; units and their sums as in systemd.time(7), a bare number is seconds."""
    if text.strip() == "infinity":
        return INFINITY
    spans, end = [], 0
    while match := re.compile(_SPAN).match(text, end):
        factor = _DURATION_UNITS.get(match[3])
        spans.append(None if factor is None else _scaled(match[1], match[2], factor))
        end = match.end()
    known = [span for span in spans if span is not None]
    if text[end:].strip() or not known or len(known) < len(spans) or sum(known) >= INFINITY:
        raise _refusal("duration", text, _DURATION_HINT)
    return sum(known)


def format_duration(duration: int) -> str:
    """The exact text of `duration` µs, such as "1min 30s"; the inverse of parse_duration."""
    if duration in (0, INFINITY):
        return "infinity" if duration else "0"
    parts, rest = [], duration
    for unit, factor in (*_DURATION_NAMES, ("us", 1)):
        count, rest = divmod(rest, factor)
        parts += [f"{count}{unit}"] * (count > 0)
    return " ".join(parts)


def parse_cpu(text: str) -> int:
    """Microseconds of CPU time per second, from cores ("2.0") or a percentage of one core ("150%").

    The result is above 0 and a multiple of 0.01 % of a core, the step of CPUQuota= in
    systemd.resource-control(5).
    """
    if text.strip() == "infinity":
        return INFINITY
    match = re.fullmatch(_CPU, text.strip())
    one = SECOND // 100 if match and match[3] else SECOND
    share = _scaled(match[1], match[2], one) if match else None
    if share is None or share < _CPU_STEP:
        raise _refusal("CPU share", text, _CPU_HINT)
    return share - share % _CPU_STEP


def format_cpu(share: int) -> str:
    """`share` µs of CPU per second as CPUQuota= takes it: "150%", with at most two decimals."""
    if share == INFINITY:
        return "infinity"
    whole, hundredths = divmod(share // _CPU_STEP, 100)
    return f"{whole}.{hundredths:02}".rstrip("0").rstrip(".") + "%"


def format_moment(at_us: int) -> str:
    """`at_us` (CLOCK_REALTIME µs) in ISO 8601 and UTC, such as "2026-11-20T18:00:00.000017Z"."""
    seconds, rest = divmod(at_us, SECOND)
    return f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(seconds))}.{rest:06}Z"


def parse_bool(text: str) -> bool:
    """True or False, from the words of systemd.syntax(7): yes, true, on, 1 and their opposites."""
    value = _BOOLEANS.get(text.strip().lower())
    if value is None:
        raise _refusal("boolean", text, "write yes or no")
    return value


def format_bool(value: bool) -> str:
    """ "yes" or "no"."""
    return "yes" if value else "no"


def _scaled(whole: str, fraction: str | None, factor: int) -> int | None:
    """`whole.fraction` times `factor`, cut to an integer; None if it exceeds 64 bits."""
    digits = fraction or ""
    if len(whole) + len(digits) > _MAX_DIGITS:
        return None
    value = int(whole + digits) * factor // 10 ** len(digits)
    return value if value < INFINITY else None


def _refusal(what: str, text: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot read {quoted(text)} as a {what}", hint)


_FIRST_CPU = INFINITY.bit_length()
"""CPUs are bits of a number, as limits are numbers. The first bit is above INFINITY: no limit."""
MOST_CPUS = 8192
"""What Linux can be built for."""
_CPU_RANGE = r"([0-9]{1,4})(?:-([0-9]{1,4}))?"


def cpu_bits(cpus: Iterable[int]) -> int:
    """The number for these CPUs."""
    return sum(1 << (_FIRST_CPU + cpu) for cpu in set(cpus))


def parse_cpus(text: str) -> int:
    """The CPUs of a list, or INFINITY for all. Raises DoraSystemdError (USAGE)."""
    if text.strip() == "infinity":
        return INFINITY
    bits = 0
    for part in text.split(","):
        match = re.fullmatch(_CPU_RANGE, part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < MOST_CPUS:
            hint = "write numbers and ranges such as 2-3 or 0,2; or infinity for all"
            raise usage_error(f"cannot use {quoted(text)} as cpus", hint)
        bits |= (1 << (last + 1)) - (1 << first)
    return bits << _FIRST_CPU


def cpu_numbers(value: int) -> list[int]:
    """The CPUs of a number, in order; none for INFINITY."""
    bits = value >> _FIRST_CPU
    return [cpu for cpu in range(bits.bit_length()) if bits >> cpu & 1]


def format_cpus(value: int) -> str:
    """The list, or "infinity"."""
    return cpus_file(value).strip() or "infinity"


def cpus_file(value: int) -> str:
    """The list as the kernel takes it; an empty line for all."""
    ranges: list[list[int]] = []
    for cpu in cpu_numbers(value):
        if ranges and ranges[-1][-1] == cpu - 1:
            ranges[-1][1:] = [cpu]
        else:
            ranges.append([cpu])
    return ",".join("-".join(map(str, one)) for one in ranges) or "\n"


def as_mapping(value: object) -> dict[str, Any]:
    """The value if it is a mapping of JSON or YAML, else an empty one."""
    return value if isinstance(value, dict) else {}


def as_list(value: object) -> list[Any]:
    """The value if it is a list of JSON or YAML, else an empty one."""
    return value if isinstance(value, list) else []


def format_number(value: int) -> str:
    """A number, or "infinity"."""
    return "infinity" if value == INFINITY else str(value)
