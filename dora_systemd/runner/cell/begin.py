"""Starts a cell: its cgroup and its coordinator. Imports only what loads quickly."""

import contextlib
import os
import pwd
import resource
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora import engine
from dora_systemd.decisions.cell.core_dumps import CORE_PATTERN, keeps_core_dumps
from dora_systemd.decisions.cell.environment import find_python, node_environment, with_place
from dora_systemd.decisions.cell.limits import has_cpus, limits_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import rights_of
from dora_systemd.paths import CellPaths

_SIGACTIONS = {"x86_64": "13", "aarch64": "134", "riscv64": "134"}
SIGACTION = {"DORA_SYSTEMD_SIGACTION": _SIGACTIONS.get(os.uname().machine, "")}
"""The variable that gives launcher.pl the number of rt_sigaction(2)."""
LIBEXEC = Path(__file__).parents[2] / "libexec"
OPENSSL = ("ssl", "_ssl", "_hashlib")


def leave_out_openssl() -> None:
    """Make the standard library work without OpenSSL, as in a Python built without it.

    A cell uses only loopback and Unix sockets, and OpenSSL would take a fifth of its memory.
    """
    sys.modules.update(dict.fromkeys(OPENSSL))  # type: ignore[arg-type]


def let_openssl_in() -> None:
    """Undo leave_out_openssl(), for a library that imports ssl."""
    for name in OPENSSL:
        if name in sys.modules and sys.modules[name] is None:
            del sys.modules[name]


def enter_supervisor() -> Path:
    """Move this process into the group `supervisor`; return the cgroup directory of the unit.

    DelegateSubgroup= does this, but systemd before 254 does not have it. Raises OSError.
    """
    own = cgroup.group_path(cgroup.group_of())
    if own.name == cgroup.SUPERVISOR:
        return own.parent
    cgroup.make_group(own / cgroup.SUPERVISOR)
    cgroup.move_process(own / cgroup.SUPERVISOR, 0)
    return own


def allow_core_dumps(root: Path = Path("/")) -> None:
    """Raise the soft limit for core dumps, which is 0 in Debian, if systemd-coredump gets them.

    Otherwise a crash of a node would leave files in the directories of nodes. A hard limit of 0
    (LimitCORE=0) stays. root: has all files. Raises OSError.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_CORE)
    if soft == 0 != hard and keeps_core_dumps((root / CORE_PATTERN).read_text(errors="replace")):
        resource.setrlimit(resource.RLIMIT_CORE, (hard, hard))


def nodes_environment(directory: str) -> dict[str, str]:
    """Return the environment of nodes that run in `directory`."""
    home = ""
    if "HOME" not in os.environ:
        with contextlib.suppress(KeyError):
            home = pwd.getpwuid(os.getuid()).pw_dir
    return node_environment(with_place(os.environ, directory, home))


def make_lock(path: Path) -> None:
    """Create the file that inhibits restarts while it is locked.

    Always a new one: a node that starts must not wait for a restart that still holds the old one.
    Raises OSError.
    """
    path.unlink(missing_ok=True)
    os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))


def start_coordinator(
    dora: str, paths: CellPaths, environment: Mapping[str, str], port: int = 0
) -> engine.Child:
    """Start a coordinator, which prints its port. environment: of the nodes.

    Raises OSError, and DoraSystemdError (NO_DORA) if dora is no program.
    """
    paths.coordinator.mkdir(mode=0o700, exist_ok=True)
    own = engine.coordinator_environment(environment, paths.coordinator)
    command = engine.coordinator_command(dora, port)
    try:
        return engine.spawn("coordinator", command, own, paths.coordinator)
    except OSError:
        # Imported late: it takes a while, and most dataflows have a dora.
        from dora_systemd.adapters.dora.command import find_dora

        find_dora(dora, None, "")
        raise


def daemon_variables(
    options: RunnerOptions, paths: CellPaths, unit: Path, environment: Mapping[str, str]
) -> dict[str, str]:
    """Return variables of the daemon that nodes do not get; launcher.pl removes them.

    unit: cgroup directory. environment: of the nodes.
    """
    search_path = environment.get("PATH") or os.defpath
    # Perl, which runs the launcher, would complain about every unknown LANG.
    own = {"DORA_QUIET": "1", "RUST_BACKTRACE": "0", "PERL_BADLANG": "0"}
    added = {key: text for key, text in own.items() if key not in os.environ}
    return {
        **added,
        "DORA_SYSTEMD_UNSET": " ".join(("DORA_QUIET", *added)),
        "DORA_SYSTEMD_CELL": str(paths.root),
        "DORA_SYSTEMD_GROUP": str(unit),
        "DORA_SYSTEMD_LIBEXEC": str(LIBEXEC),
        "DORA_SYSTEMD_DIRECTORY": options.working_directory,
        "DORA_SYSTEMD_PYTHON": find_python(options.venv, search_path, os.path.exists),
        "PATH": f"{LIBEXEC}:{search_path}",
        **_rights(options, unit),
        **SIGACTION,
    }


def _rights(options: RunnerOptions, unit: Path) -> dict[str, str]:
    if not rights_of(options) and not any(map(has_cpus, limits_of(options))):
        return {}
    # Imported late: most dataflows have neither.
    from dora_systemd.runner.nodes.rights import launcher_rights

    return {"DORA_SYSTEMD_RIGHTS": launcher_rights(options, unit)}


class Daemon(NamedTuple):
    """A daemon of dora."""

    child: engine.Child
    held: socket.socket  # its port for dynamic nodes; held as long as it runs

    @property
    def listen(self) -> int:
        """Its port for dynamic nodes."""
        return int(self.held.getsockname()[1])


def start_daemon(
    dora: str,
    paths: CellPaths,
    port: int,
    environment: Mapping[str, str],
    token: str = "",
    more: Sequence[str] = (),
) -> Daemon:
    """Start a daemon for the coordinator on `port`. Raises OSError.

    environment: of the nodes, with daemon_variables. token: if the coordinator is on another
    machine. more: arguments.
    """
    paths.daemon.mkdir(mode=0o700, exist_ok=True)
    own = {**environment, "DORA_AUTH_TOKEN": token or read_token(paths)}
    with contextlib.ExitStack() as undo:
        held = undo.enter_context(engine.reserved_port())
        command = [*engine.daemon_command(dora, port, held.getsockname()[1]), *more]
        child = engine.spawn("daemon", command, own, paths.daemon)
        undo.pop_all()
    return Daemon(child, held)


def read_token(paths: CellPaths) -> str:
    """Read the token that the listening coordinator has written. Raises OSError."""
    return (paths.coordinator / ".dora-token").read_text().strip()
