"""LAB=container: systemd-nspawn boots the tree; commands enter it with nsenter."""

import os
import select
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from lab import cgroup, image
from lab.bytecode import ensure_bytecode
from lab.cache import find_cache
from lab.errors import LabError
from lab.options import Options
from lab.pace import bound
from lab.process import die_with_parent, need_tools, read_last_line, run_logged
from lab.runs import Run, note, remove_cgroup
from lab.service import service_command
from lab.terminal import is_terminal, kept_terminal

BOOT_SECONDS = 60.0
# dora's shared memory needs mlock(), which nspawn forbids otherwise.
CAPABILITIES = "CAP_IPC_LOCK"


@dataclass(frozen=True)
class Container:
    leader: int
    supervisor: Path  # nspawn's own cgroup, beside the payload's


def run_in_container(run: Run, tree: Path, options: Options) -> int:
    need_tools("systemd-nspawn")
    place_checkout(run.directory / "src")
    hide_traces(run)
    disk = insert_disk(run.directory, tree) if len(options.commands) > 1 else None
    status = 0
    for number, command in enumerate(options.commands):
        with started_container(run, tree, options.out, disk) as container, kept_terminal():
            words = enter_command(container, replace(options, commands=(command,)))
            status = subprocess.run(words, check=False).returncode
            if status:
                break
            if number < len(options.commands) - 1:
                shut_down(container, run.directory / "shutdown.log")
    return status


def place_checkout(source: Path) -> None:
    """Put a copy of the checkout there, with its modules compiled."""
    source.mkdir(mode=0o755)
    image.copy_checkout(source)
    unpack = ["tar", "--extract", f"--file={ensure_bytecode()}", "--strip-components=1"]
    subprocess.run([*unpack, f"--directory={source}"], check=True)


def insert_disk(place: Path, tree: Path) -> Path:
    """The image as a disk that outlives a boot; what is written to it is below `place`."""
    root, upper, work = (place / name for name in ("root", "upper", "work"))
    for directory in (root, upper, work):
        directory.mkdir(mode=0o755, parents=True)
    options = f"lowerdir={tree},upperdir={upper},workdir={work}"
    command = ["mount", "-t", "overlay", place.name, "-o", options, str(root)]
    run_logged(command, place / "disk.log", "mount a disk")
    return root


@contextmanager
def started_container(
    run: Run, tree: Path, out: Path | None, disk: Path | None
) -> Iterator[Container]:
    enter, path = cgroup.enter_command(run.name)
    note(run, "cgroup", path)
    ready = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    told = run.directory / "notify"
    told.unlink(missing_ok=True)
    ready.bind(str(told))
    nspawn = start_nspawn(run, [*enter, *nspawn_command(run, tree, out, disk)])
    try:
        # Closed then: in a socket that nobody reads nspawn would wait, and PID 1 for nspawn.
        with ready:
            leader = wait_ready(ready, nspawn, run)
        yield Container(leader, path / "supervisor")
    finally:
        cgroup.note_usage(path)
        remove_cgroup(path)
        nspawn.kill()
        nspawn.wait()


def hide_traces(run: Run) -> None:
    """nspawn leaves directories and mounts here when it is killed; they end with our namespace."""
    place = Path("/run/systemd/nspawn")
    place.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", run.name, str(place)], check=True)


def start_nspawn(run: Run, command: list[str]) -> subprocess.Popen[bytes]:
    extra = {
        "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1",
        "SYSTEMD_NSPAWN_LOCK": "0",  # the tree is only read, by many at once
        "NOTIFY_SOCKET": str(run.directory / "notify"),
    }
    with (run.directory / "log").open("wb") as log:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={"PATH": image.CLEAN_PATH, "TMPDIR": str(run.directory), **extra},
            start_new_session=True,  # Ctrl+C is for the command; the lab ends the container
        )


def nspawn_command(run: Run, tree: Path, out: Path | None, disk: Path | None) -> list[str]:
    return die_with_parent([
        *nspawn_words(run, disk or tree, "lab"), *([] if disk else ["--volatile=overlay"]),
        f"--bind={run.directory / 'src'}:/src", *([f"--bind={out}:/out"] if out else []),
    ])  # fmt: skip


def nspawn_words(run: Run, root: Path, hostname: str) -> list[str]:
    return [
        "systemd-nspawn", "--register=no", "--keep-unit", "--quiet", "--boot",
        f"--directory={root}", f"--machine={run.name}", f"--hostname={hostname}",
        "--private-network", "--resolv-conf=off", "--timezone=off", "--link-journal=no",
        f"--capability={CAPABILITIES}", "--console=pipe", "--notify-ready=yes",
    ]  # fmt: skip


def wait_ready(
    ready: socket.socket,
    nspawn: subprocess.Popen[bytes],
    run: Run,
    on_leader: Callable[[], None] = lambda: None,
) -> int:
    """nspawn tells the leader's pid when it forks it, and READY=1 when that has booted."""
    leader = 0
    ended = os.pidfd_open(nspawn.pid)
    told = ready.fileno()
    try:
        while select.select([told, ended], [], [], bound(BOOT_SECONDS))[0] == [told]:
            message = ready.recv(4096).decode().splitlines()
            fields = dict(line.partition("=")[::2] for line in message)
            if not leader and "X_NSPAWN_LEADER_PID" in fields:
                leader = int(fields["X_NSPAWN_LEADER_PID"])
                on_leader()
            if "READY" in fields and leader:
                return leader
    finally:
        os.close(ended)
    kept = shutil.copy(run.directory / "log", find_cache() / "boot.log")
    raise LabError(f"boot the container: {read_last_line(run.directory / 'log')}", f"see {kept}")


def enter_command(container: Container, options: Options) -> list[str]:
    """In the run's cgroup as well: whatever ends that ends this too, before it can complain."""
    join = cgroup.join_command(container.supervisor)
    command = service_command(options.commands[0], options, is_terminal())
    return [*join, *nsenter_words(container), *command]


def nsenter_words(container: Container) -> list[str]:
    return ["nsenter", f"--target={container.leader}", "--all", "--"]


def shut_down(container: Container, log: Path) -> None:
    """Its systemd stops everything, as before a reboot of a machine."""
    ended = os.pidfd_open(container.leader)
    try:
        command = [*nsenter_words(container), "systemctl", "poweroff"]
        run_logged(command, log, "shut down the container")
        if not select.select([ended], [], [], bound(BOOT_SECONDS))[0]:
            raise LabError("shut down the container", "does a unit take too long to stop?")
    finally:
        os.close(ended)
