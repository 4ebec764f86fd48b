"""What must hold after a fault, whatever it was."""

from collections.abc import Callable
from enum import Enum
from pathlib import Path

from tests.system.cells import is_alive, wait_for
from tests.system.faults.apply import process_state
from tests.system.faults.scene import ROLES, Scene


class Outcome(Enum):
    """What becomes of the dataflow."""

    UNAFFECTED = "unaffected"
    DORA = "healed by dora"
    SYSTEMD = "healed by systemd"
    ENDED = "ended in good order"
    FAILED = "failed, and says why"


def check_unaffected(scene: Scene) -> bool:
    """The same processes, and every node prints on."""
    state = scene.state()
    assert state.restarts == scene.before.restarts
    assert state.node_restarts == scene.before.node_restarts
    return state.pids == scene.before.pids and is_exchanging(scene)


def check_dora(scene: Scene) -> bool:
    """The same cell, in which dora has started again what was hit, and every node prints on."""
    state = scene.state()
    assert state.restarts == scene.before.restarts
    # Dora finds stopped nodes one by one, and what they printed before counts as printed since.
    if any(process_state(pid) == "T" for pid in state.pids):
        return False
    # The table has the process of one that dora has just killed for a moment still.
    if any(scene.cell.status.nodes[role].pid not in state.pids for role in ROLES):
        return False
    return state.node_restarts != scene.before.node_restarts and is_exchanging(scene)


def check_systemd(scene: Scene) -> bool:
    """Started again as a whole, once; nothing of what was before is there any more."""
    restarts = int(scene.cell.show("NRestarts"))
    assert restarts - scene.before.restarts <= 1
    if restarts == scene.before.restarts or scene.cell.show("ActiveState") != "active":
        return False
    assert not [pid for pid in scene.before.pids if is_alive(pid)]
    return is_exchanging(scene)


def is_exchanging(scene: Scene) -> bool:
    """Whether the dataflow runs as a whole and every node has printed since the fault."""
    if not scene.cell.paths.status.exists():
        return False
    nodes = scene.cell.status.nodes
    if any(nodes[role].state != "running" for role in ROLES):
        return False
    before = scene.before.counts
    new = {r: [c for life, c in scene.lives(r).items() if c > before.get(life, 0)] for r in ROLES}
    return all(new.values())


def check_ended(scene: Scene) -> bool:
    """Gone, with success."""
    return scene.cell.show("ActiveState") == "inactive" and scene.cell.show("Result") == "success"


def check_failed(scene: Scene) -> bool:
    """Gone, and not started again."""
    return scene.cell.show("ActiveState") == "failed"


RECOVERED: dict[Outcome, Callable[[Scene], bool]] = {
    Outcome.UNAFFECTED: check_unaffected,
    Outcome.DORA: check_dora,
    Outcome.SYSTEMD: check_systemd,
    Outcome.ENDED: check_ended,
    Outcome.FAILED: check_failed,
}


def check_list(scene: Scene, outcome: Outcome, cause: str) -> None:
    """`doractl list` says what is true."""
    row = scene.listed()
    if outcome is Outcome.ENDED:
        assert row["status"] in ("Stopped", "Finished")
    elif outcome is Outcome.FAILED:
        assert (row["status"], cause in row["text"]) == ("Failed", True), row["text"]
    else:
        assert row["status"] == "Running"
        for node in row["nodes"]:
            assert node["state"] == "running"
            # Nor is anything there that an earlier life of it has left behind.
            assert scene.cell.pids(f"node-{node['node']}") == [node["pid"]]


def check_cause(scene: Scene, cause: str) -> None:
    """The journal has the cause."""
    said = [str(record["MESSAGE"]) for record in scene.cell.journal()]
    assert any(cause in message for message in said), said[-20:]


def check_nothing_is_outside(scene: Scene) -> None:
    """Every process that comes from the dataflow is in its unit's cgroup."""
    outside = {p: g for p, g in scene.processes().items() if scene.cell.unit not in g.split("/")}
    assert not outside, outside


def check_nothing_is_left(scene: Scene, group: Path) -> None:
    """The unit has ended: no process of it, no cgroup, no directory."""
    wait_for("no process is left", lambda: not scene.processes(), 5)
    wait_for("no cgroup is left", lambda: not group.exists(), 5)
    assert not scene.cell.paths.root.exists()


def check_lines(scene: Scene, repeats: int) -> None:
    """Every line of every life is in the journal, in order and once.

    repeats: so many lines may be there twice, where the runner is killed between a line and the
    note that it has been written.
    """
    printed = scene.printed()
    lives = {life: count for role in ROLES for life, count in scene.lives(role).items()}
    assert len(lives) >= len(ROLES)
    for life, count in lives.items():
        numbers = printed.get(life, [])
        unique = sorted(set(numbers))
        assert unique == list(range(1, len(unique) + 1)), (life, count, numbers)
        assert len(unique) >= count, (life, count, len(unique))
        assert len(numbers) - len(unique) <= repeats, life
        assert repeats or numbers == unique, life
