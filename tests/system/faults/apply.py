"""How each fault is brought about. Each function returns when the fault has truly happened."""

import errno
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path

from dora_systemd.adapters.cgroup.groups import read_numbers
from tests.system.cells import is_alive, run, wait_for
from tests.system.faults.scene import ROLES, Scene

Apply = Callable[[Scene], None]


def process_state(pid: int) -> str:
    """The letter of /proc/PID/stat, "" if it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]
    except OSError:
        return ""


def signalled(pids: list[int], number: signal.Signals) -> None:
    """Send a signal, and see that it has had its effect."""
    assert pids
    for pid in pids:
        os.kill(pid, number)
    if number is signal.SIGSTOP:
        wait_for("stopped", lambda: all(process_state(pid) == "T" for pid in pids))
    else:
        wait_for("dead", lambda: not any(is_alive(pid) for pid in pids))


def part(what: str, number: signal.Signals) -> Apply:
    """A signal to the runner, the coordinator or the daemon."""
    return lambda scene: signalled([scene.cell.supervisor_pid(what)], number)


def nodes(number: signal.Signals, *roles: str) -> Apply:
    """A signal to nodes."""

    def apply(scene: Scene) -> None:
        signalled([pid for role in roles for pid in scene.cell.pids(f"node-{role}")], number)

    return apply


def all_nodes(number: signal.Signals) -> Apply:
    """A signal to all nodes."""
    return nodes(number, *ROLES)


def order(role: str, what: str) -> Apply:
    """A node does something by itself."""
    return lambda scene: scene.order(role, what)


def death(role: str, what: str) -> Apply:
    """A node does something of which it ends."""

    def apply(scene: Scene) -> None:
        (pid,) = scene.cell.pids(f"node-{role}")
        scene.order(role, what)
        wait_for("dead", lambda: not is_alive(pid))

    return apply


def command(*words: str) -> Apply:
    """Something that the administrator does."""

    def apply(scene: Scene) -> None:
        del scene
        run(*words)

    return apply


def restarted(unit: str) -> Apply:
    """Another service is restarted, and has another process then."""

    def main_pid() -> str:
        return run("systemctl", "show", "--value", "--property=MainPID", unit).stdout.strip()

    def apply(scene: Scene) -> None:
        del scene
        before = main_pid()
        run("systemctl", "restart", unit)
        wait_for("it is new", lambda: main_pid() not in ("0", before))

    return apply


def kill_unit(scene: Scene) -> None:
    """`systemctl kill -s KILL`: all processes at once."""
    scene.cell.systemctl("kill", "--signal=KILL")
    wait_for("dead", lambda: not any(is_alive(pid) for pid in scene.before.pids))


def stubborn(scene: Scene) -> None:
    """A node that nothing but SIGKILL ends, and then a stop."""
    scene.order("sink", "ignore")
    (pid,) = scene.cell.pids("node-sink")
    ignored = 1 << (signal.SIGTERM - 1)
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    (mask,) = [line.split()[1] for line in status if line.startswith("SigIgn")]
    assert int(mask, 16) & ignored
    scene.cell.systemctl("stop", "--no-block")


def reexec_in_start(scene: Scene) -> None:
    """systemd executes itself anew while it starts the dataflow again."""
    part("daemon", signal.SIGKILL)(scene)
    wait_for("it starts", lambda: scene.cell.show("SubState") == "start")
    run("systemctl", "daemon-reexec")


def delete_directory(scene: Scene) -> None:
    """The RuntimeDirectory is deleted."""
    shutil.rmtree(scene.cell.paths.root)
    assert not scene.cell.paths.root.exists()


def mount_project(scene: Scene) -> None:
    """Give the project a file system of its own."""
    scene.mount(scene.project.root, "1M")


def read_only_project(scene: Scene) -> None:
    """The project cannot be written any more, and a node has to be started again."""
    run("mount", "-o", "remount,ro", str(scene.project.root))
    try:
        (scene.project.root / "new").touch()
    except OSError as error:
        assert error.errno == errno.EROFS
    else:
        raise AssertionError("it can be written")
    nodes(signal.SIGKILL, "doubler")(scene)


def fill_out(scene: Scene) -> None:
    """There is no room where dora writes its own logs, and a node has to be started again."""
    out = scene.cell.paths.work / "out"
    logs = sorted(out.glob("*/log_*.jsonl"))
    assert logs
    scene.mount(out, "64k")
    for log in logs:
        log.parent.mkdir(exist_ok=True)
        log.touch()
    run("chown", "--recursive", f"--reference={scene.cell.paths.work}", str(out))
    try:
        (out / "big").write_bytes(bytes(1 << 20))
    except OSError as error:
        assert error.errno == errno.ENOSPC
    else:
        raise AssertionError("there is room")
    nodes(signal.SIGKILL, "doubler")(scene)


def fork_bomb(scene: Scene) -> None:
    """A node forks as often as its limit of tasks lets it, and fails."""
    death("sink", "fork-bomb")(scene)
    events = read_numbers(scene.cell.group / "node-sink" / "pids.events")
    assert events["max"] > 0


def clock(seconds: int) -> Apply:
    """The clock of the machine is set forward or back."""

    def apply(scene: Scene) -> None:
        del scene
        before = time.time() - time.monotonic()
        run("date", f"--set=@{time.time() + seconds:.3f}")
        assert abs(time.time() - time.monotonic() - before - seconds) < 60

    return apply
