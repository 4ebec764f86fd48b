"""Gates, with the real launcher at them."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import dora_systemd
from dora_systemd.decisions.cell.exits import Exit, exit_of
from dora_systemd.paths import CellPaths
from dora_systemd.runner.nodes.launcher_gates import Gates

LAUNCHER = Path(dora_systemd.__file__).parent / "launcher.pl"


@pytest.fixture
def gates(tmp_path: Path) -> Iterator[Gates]:
    (tmp_path / "io").mkdir()
    (tmp_path / "node-one").mkdir()
    gates = Gates(CellPaths(tmp_path))
    gates.make(["one"])
    yield gates
    gates.close("one")


def launch(root: Path) -> "subprocess.Popen[bytes]":
    """The launcher of node `one`, whose program exits with 7."""
    environment = {
        "PATH": "/usr/bin:/bin",
        "DORA_SYSTEMD_CELL": str(root),
        "DORA_SYSTEMD_GROUP": str(root),
        "DORA_SYSTEMD_LIBEXEC": "/nowhere",
        "DORA_SYSTEMD_UNSET": "",
    }
    words = ("one", str(root), "keep", "/bin/sh", "-c", "exit 7")
    return subprocess.Popen(["/usr/bin/perl", str(LAUNCHER), *words], env=environment)


def is_waiting(child: "subprocess.Popen[bytes]") -> bool:
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(0.2)
    return True


def test_a_launcher_waits_until_its_gate_opens(gates: Gates, tmp_path: Path) -> None:
    child = launch(tmp_path)
    assert is_waiting(child)
    gates.open("one")
    assert child.wait(60) == 7


def test_an_open_gate_lets_every_launcher_go_on_until_it_closes(
    gates: Gates, tmp_path: Path
) -> None:
    gates.open("one")
    assert [launch(tmp_path).wait(60) for _ in range(3)] == [7, 7, 7]
    gates.refill("one")
    gates.close("one")
    child = launch(tmp_path)
    assert is_waiting(child)
    gates.open("one")
    assert child.wait(60) == 7


@pytest.mark.parametrize("end", [exit_of(3), exit_of(-9), exit_of(-15), exit_of(255)])
def test_a_given_up_node_ends_as_it_has_ended_before(
    gates: Gates, tmp_path: Path, end: Exit
) -> None:
    gates.open("one")
    gates.end("one", end)
    assert exit_of(launch(tmp_path).wait(60)) == end


def test_a_hung_node_is_given_up_as_failed(gates: Gates, tmp_path: Path) -> None:
    gates.end("one", Exit(words="hung"))
    assert launch(tmp_path).wait(60) == 1


def test_the_end_of_the_run_ends_those_that_wait_and_no_others(
    gates: Gates, tmp_path: Path
) -> None:
    waiting = launch(tmp_path)
    gates.dismiss()
    assert waiting.wait(60) == 0
    assert launch(tmp_path).wait(60) == 0
    gates.open("one")  # too late
    assert launch(tmp_path).wait(60) == 0
    gates.make(["one"])  # the next run
    assert is_waiting(child := launch(tmp_path))
    gates.open("one")
    gates.dismiss()
    assert child.wait(60) == 7
    assert launch(tmp_path).wait(60) == 7  # past its gate: dora's stop ends it


def test_a_waiting_launcher_dies_of_a_signal(gates: Gates, tmp_path: Path) -> None:
    assert (tmp_path / "io/one.gate").is_fifo()
    gates.close("one")
    child = launch(tmp_path)
    assert is_waiting(child)
    child.terminate()
    assert child.wait(60) == -15


def test_a_gate_that_somebody_has_replaced_is_no_gate(gates: Gates, tmp_path: Path) -> None:
    gate = tmp_path / "io/one.gate"
    gate.unlink()
    gate.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match=r"one\.gate"):
        gates.open("one")
    assert not (tmp_path / "elsewhere").exists()
    gate.unlink()


def test_the_next_run_finds_no_gate_of_the_last_one(gates: Gates, tmp_path: Path) -> None:
    """Its launchers would leave at one that has been dismissed."""
    gates.dismiss()
    gates.remove()
    assert not CellPaths(tmp_path).node_gate("one").exists()
    gates.dismiss()
    assert not CellPaths(tmp_path).node_gate("one").exists()
