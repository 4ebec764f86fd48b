"""Who gets the core dumps of this machine: kernel.core_pattern, see core(5). Pure."""

import re

CORE_PATTERN = "proc/sys/kernel/core_pattern"
# systemd 262 has the second form, with Linux 6.17.
_COREDUMP = r"\|(\S*/systemd-coredump)(?:\s|$)|@@?/run/systemd/coredumpd/"


def keeps_core_dumps(pattern: str) -> bool:
    """Whether systemd-coredump(8) gets the core dumps."""
    return re.match(_COREDUMP, pattern.strip()) is not None


def core_program(pattern: str) -> str:
    """The path of systemd-coredump in the pattern, "" for another pattern."""
    found = re.match(_COREDUMP, pattern.strip())
    return (found[1] or "") if found else ""
