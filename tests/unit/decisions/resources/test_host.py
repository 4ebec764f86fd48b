"""What the machine uses, from texts of /proc that may be of any kernel."""

import pytest

from dora_systemd.decisions.resources.host import (
    Disk,
    HostUse,
    fullest,
    parse_memory,
    parse_ticks,
)

STAT = "cpu  100 5 50 800 40 1 2 3 70 7\ncpu0 1 2 3 4\n"


def test_ticks() -> None:
    assert parse_ticks(STAT) == (161, 1001), "guest is a part of user"


@pytest.mark.parametrize("text", ["", "cpu", "cpu 1 2", "cpu0 1 2 3 4 5", "cpu a b c d e f"])
def test_ticks_of_something_else(text: str) -> None:
    assert parse_ticks(text) == (None, None)


def test_memory() -> None:
    text = "MemTotal:        2048 kB\nMemFree: 1 kB\nMemAvailable:    1024 kB\n"
    assert parse_memory(text) == (2 << 20, 1 << 20)
    assert parse_memory("MemTotal: much") == (None, None)


def test_the_fullest_disk() -> None:
    root, var = Disk("/", 100, 50), Disk("/var", 1000, 400)
    assert fullest([root, var]) == var
    assert fullest([]) is None
    assert HostUse(disk=var).values()["disk_free_bytes"] == 400
    assert HostUse().values()["disk"] is None
