"""Formats the values of rows for terminals."""

import time

from dora_systemd.values import SECOND, format_duration, format_rounded_size

UNKNOWN = "-"


def format_uptime(duration: int | None) -> str:
    """`duration` µs as "00:05:32", from one day on with "1d " in front."""
    if duration is None:
        return UNKNOWN
    minutes, seconds = divmod(duration // SECOND, 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    clock = f"{hours:02}:{minutes:02}:{seconds:02}"
    return f"{days}d {clock}" if days else clock


def format_percent(percent: float | None, limit: float | None = None) -> str:
    """Percent of one processor, as in "12.5", or "12.5/50" with a limit."""
    text = UNKNOWN if percent is None else f"{percent:.1f}"
    return text if limit is None else f"{text}/{limit:g}"


def format_memory(size: int | None, limit: int | None = None) -> str:
    """Bytes for a table, as in "256M", or "256M/4G" with a limit."""
    text = UNKNOWN if size is None else format_rounded_size(size)
    return text if limit is None else f"{text}/{format_rounded_size(limit)}"


def format_count(count: int | None) -> str:
    """A number, or the sign for unknown."""
    return UNKNOWN if count is None else str(count)


def format_watchdog(age: int | None, limit: int | None) -> str:
    """Format "1.2s/5s", the age of the last WATCHDOG=1 and its limit; "" without a watchdog."""
    if age is None and limit is None:
        return ""
    known = UNKNOWN if age is None else f"{age / SECOND:.1f}s"
    return known if limit is None else f"{known}/{format_duration(limit)}"


def local_time(moment: int, form: str = "%Y-%m-%d %H:%M:%S") -> str:
    """CLOCK_REALTIME µs as "2026-01-15 13:00:00" in the local time zone; 0 is unknown.

    form: as for strftime(3).
    """
    return time.strftime(form, time.localtime(moment / SECOND)) if moment else UNKNOWN


def zoned_time(moment: int) -> str:
    """Format a time as local_time() does, followed by the name of the zone."""
    return local_time(moment, "%Y-%m-%d %H:%M:%S %Z")
