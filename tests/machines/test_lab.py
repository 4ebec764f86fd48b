"""The lab's own machines."""

import pytest

from tests.machines.wires import OTHERS, cable, power_cut, there
from tests.system.cells import run


def test_each_is_a_machine_of_its_own() -> None:
    ids = {there(name, "cat", "/etc/machine-id").stdout for name in ("a", *OTHERS)}
    assert len(ids) == 3
    assert [there(name, "hostname", user="alice").stdout for name in OTHERS] == ["b\n", "c\n"]
    listening = run("ss", "-Hltn").stdout
    assert [line.split()[3] for line in listening.splitlines()] == ["0.0.0.0:22", "[::]:22"]


@pytest.mark.parametrize("how", ["off", "mute"])
def test_a_cable(how: str) -> None:
    with cable("b", how):
        assert there("b", "true").returncode == 255
        assert there("c", "true").returncode == 0


def test_a_power_cut() -> None:
    there("b", "sh", "-c", "'echo kept > /root/kept'")
    before = there("b", "cat", "/proc/sys/kernel/random/boot_id").stdout
    with power_cut("b"):
        assert there("b", "true").returncode == 255
    assert there("b", "cat", "/root/kept").stdout == "kept\n"
    after = there("b", "cat", "/proc/sys/kernel/random/boot_id").stdout
    assert before != after != ""
