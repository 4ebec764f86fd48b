"""What is read of the machine; what is missing costs nothing else."""

from pathlib import Path

from dora_systemd.verbs.facts.host import read_host


def test_this_machine() -> None:
    found = read_host()
    assert found.ticks and found.busy is not None and found.busy <= found.ticks
    assert found.memory and found.available and found.available <= found.memory
    assert found.disk and found.disk.free <= found.disk.size


def test_nothing_to_read(tmp_path: Path) -> None:
    found = read_host(tmp_path, (str(tmp_path / "gone"),))
    assert (found.busy, found.memory, found.disk) == (None, None, None)
