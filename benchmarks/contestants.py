"""Those who keep a dataflow running: doractl, and what people would take instead.

Each is used as its own manual says, and is warm: its daemon, if it has one, runs before the clock
does, and knows the program. dora finds Python in VIRTUAL_ENV, as ours does.
"""

import os
import shutil
import signal
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from benchmarks.flows import HOME, STAMPS
from tests.system.cells import Cell, command_line, run, wait_for

NAME = "bench"
RIVALS = Path("/opt/rivals/bin")
ENVIRONMENT = {"VIRTUAL_ENV": "/opt/lab", "PATH": f"/opt/lab/bin:{os.environ['PATH']}"}


class Contestant(ABC):
    """What a user does with the dataflow in a file; each method is one command."""

    name: str

    def __init__(self, flow: Path) -> None:
        self.flow = flow

    def prepare(self) -> None:  # noqa: B027 - not all have a daemon
        """What is done once, on a machine that boots."""

    @abstractmethod
    def start(self) -> None:
        """Start it; the nodes need not be ready."""

    @abstractmethod
    def stop(self) -> None:
        """Stop it."""

    def restart(self) -> None:
        """Stop it and start it again; by hand, where there is no such command."""
        self.stop()
        self.start()

    @abstractmethod
    def main_pid(self) -> int:
        """Of the process whose loss is the loss of the dataflow."""

    def daemon_pids(self) -> list[int]:
        """Of what is there for the dataflow and is neither dora nor a node."""
        return []

    def dora_pids(self) -> list[int]:
        """Of dora's own processes."""
        return [self.main_pid()]

    def close(self) -> None:  # noqa: B027
        """Leave nothing behind."""


class Supervisor(Contestant):
    """One whose command controls programs by their names."""

    @abstractmethod
    def control(self, *words: str) -> str:
        """One command, and what it printed."""

    def start(self) -> None:
        self.control("start", NAME)

    def stop(self) -> None:
        self.control("stop", NAME)

    def restart(self) -> None:
        self.control("restart", NAME)

    def main_pid(self) -> int:
        return int(self.control("pid", NAME))


class Doractl(Contestant):
    """Ours. The nodes write their stamps through the sandbox."""

    name = "doractl"
    more: tuple[str, ...] = ()

    def start(self) -> None:
        settings = ("--writable", str(STAMPS), "--restart-policy", "always", *self.more)
        run("doractl", "start", str(self.flow), "--name", NAME, *settings)

    def stop(self) -> None:
        run("doractl", "stop", NAME)

    def restart(self) -> None:
        run("doractl", "restart", NAME)

    def main_pid(self) -> int:
        return Cell(NAME).supervisor_pid("daemon")

    def daemon_pids(self) -> list[int]:
        return [Cell(NAME).supervisor_pid("runner")]

    def dora_pids(self) -> list[int]:
        return [Cell(NAME).supervisor_pid(one) for one in ("coordinator", "daemon")]

    def close(self) -> None:
        Cell(NAME).end()


class DoraRun(Contestant):
    """`dora run` in a terminal; Ctrl+C."""

    name = "dora run"
    process: subprocess.Popen[bytes] | None = None
    user: str | None = None

    def start(self) -> None:
        log = (HOME / "dora-run.log").open("wb")
        command = ["dora", "run", str(self.flow)]
        environment = {**os.environ, **ENVIRONMENT}
        self.process = subprocess.Popen(
            command, stdout=log, stderr=log, env=environment, user=self.user, group=self.user
        )

    def stop(self) -> None:
        if self.process:
            self.process.send_signal(signal.SIGINT)
            self.process.wait()

    def main_pid(self) -> int:
        assert self.process
        return self.process.pid


def make_logs_of(user: str) -> None:
    """Give a user the directory beside the dataflow into which dora writes its logs."""
    logs = HOME / "out"
    logs.mkdir(exist_ok=True)
    shutil.chown(logs, user, user)


class DoraRunOfUser(DoraRun):
    """The same as the user whom ours runs as: root may lock more memory for large messages."""

    user = "dora"

    def prepare(self) -> None:
        make_logs_of(self.user)


class DoraUp(Contestant):
    """`dora up`, and the dataflow in that daemon."""

    name = "dora up, start"
    pids: tuple[int, ...]
    user: str | None = None

    def dora(self, *words: str, check: bool = True) -> None:
        """One command."""
        run("dora", *words, check=check, env=self.environment(), cwd=HOME, user=self.user)

    def environment(self) -> dict[str, str]:
        """Variables of a command."""
        return {**os.environ, **ENVIRONMENT}

    def prepare(self) -> None:
        before = processes_of_dora()
        self.dora("up")
        self.pids = tuple(processes_of_dora() - before)

    def start(self) -> None:
        self.dora("start", str(self.flow), "--name", NAME, "--detach")

    def stop(self) -> None:
        self.dora("stop", "--name", NAME)

    def restart(self) -> None:
        self.dora("restart", "--name", NAME)

    def main_pid(self) -> int:
        return next(pid for pid in self.pids if "daemon" in command_line(pid))

    def dora_pids(self) -> list[int]:
        return list(self.pids)

    def close(self) -> None:
        self.dora("down", "--force", check=False)
        # On a loaded machine it gives up before they have ended.
        for pid in self.pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


class DoraUpOfUser(DoraUp):
    """The same as the user whom ours runs as."""

    user = "dora"

    def environment(self) -> dict[str, str]:
        return {**super().environment(), "HOME": str(HOME / "out")}

    def prepare(self) -> None:
        make_logs_of(self.user)
        super().prepare()

    def stop(self) -> None:
        self.dora("stop", "--name", NAME, check=False)  # its nodes may have ended


class SystemdRun(Contestant):
    """`systemd-run dora run`: systemd without us.

    The delay is ours; dora alone is told to stop, or its nodes would fail of the signal.
    """

    name = "systemd-run dora run"
    unit = f"rival-{NAME}.service"

    def start(self) -> None:
        wanted = ("Restart=always", "RestartSec=500ms", "KillMode=mixed")
        properties = [word for one in wanted for word in ("-p", one)]
        variables = [f"--setenv={key}={value}" for key, value in ENVIRONMENT.items()]
        command = ("dora", "run", str(self.flow))
        unit = ("--collect", f"--unit={self.unit}")
        run("systemd-run", "-q", *unit, *properties, *variables, *command)

    def stop(self) -> None:
        run("systemctl", "stop", self.unit)

    def restart(self) -> None:
        run("systemctl", "restart", self.unit)

    def main_pid(self) -> int:
        return int(run("systemctl", "show", "-P", "MainPID", self.unit).stdout)

    def close(self) -> None:
        run("systemctl", "stop", self.unit, check=False)


SUPERVISORD = """[supervisord]
logfile={home}/supervisord.log
pidfile={home}/supervisord.pid
[unix_http_server]
file={home}/supervisor.sock
[supervisorctl]
serverurl=unix://{home}/supervisor.sock
[rpcinterface:supervisor]
supervisor.rpcinterface_factory = supervisor.rpcinterface:make_main_rpcinterface
"""
SUPERVISED = """[program:{name}]
command={command}
autostart=false
autorestart=true
"""


class Supervisord(Supervisor):
    """supervisord, with `dora run` as its program."""

    name = "supervisord"

    def prepare(self) -> None:
        program = SUPERVISED.format(name=NAME, command=f"/opt/lab/bin/dora run {self.flow}")
        self.begin(program)

    def begin(self, programs: str) -> None:
        """Start the daemon with these programs."""
        config = HOME / "supervisord.conf"
        config.write_text(SUPERVISORD.format(home=HOME) + programs)
        run(f"{RIVALS}/supervisord", "-c", str(config), env={**os.environ, **ENVIRONMENT})

    def control(self, *words: str) -> str:
        """One command, and what it printed."""
        config = HOME / "supervisord.conf"
        command = (f"{RIVALS}/supervisorctl", "-c", str(config), *words)
        return run(*command, check=words[0] != "status").stdout

    def daemon_pids(self) -> list[int]:
        return [int((HOME / "supervisord.pid").read_text())]

    def close(self) -> None:
        self.control("shutdown")
        wait_for("supervisord is gone", lambda: not (HOME / "supervisord.pid").exists())


CIRCUS = """[circus]
endpoint = ipc://{home}/circus
pubsub_endpoint = ipc://{home}/circus-pubsub
"""
CIRCUS_WATCHER = """[watcher:{name}]
cmd = {command}
copy_env = True
autostart = False
"""


class Circus(Supervisor):
    """circusd, with `dora run` as its watcher."""

    name = "circus"
    process: subprocess.Popen[bytes]

    def prepare(self) -> None:
        watcher = CIRCUS_WATCHER.format(name=NAME, command=f"/opt/lab/bin/dora run {self.flow}")
        self.begin(watcher)

    def begin(self, watchers: str) -> None:
        """Start the daemon with these watchers."""
        config = HOME / "circus.ini"
        config.write_text(CIRCUS.format(home=HOME) + watchers)
        log = (HOME / "circus.log").open("wb")
        self.process = subprocess.Popen(
            [f"{RIVALS}/circusd", str(config)],
            stdout=log,
            stderr=log,
            env={**os.environ, **ENVIRONMENT},
        )
        wait_for("circusd", lambda: ": " in self.control("status", check=False), 60)

    def control(self, *words: str, check: bool = True) -> str:
        """One command, and what it printed."""
        endpoint = f"ipc://{HOME}/circus"
        command = (f"{RIVALS}/circusctl", "--endpoint", endpoint, "--timeout", "60", *words)
        return run(*command, check=check).stdout

    def stop(self) -> None:
        self.control("stop", NAME, "--waiting")

    def main_pid(self) -> int:
        return child_of(self.process.pid)

    def daemon_pids(self) -> list[int]:
        return [self.process.pid]

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


class Pm2(Supervisor):
    """pm2, with `dora run` as its app."""

    name = "pm2"

    def control(self, *words: str) -> str:
        """One command, and what it printed."""
        own = {"PM2_HOME": str(HOME / "pm2"), "HOME": str(HOME), "CI": "1"}
        variables = {**os.environ, **ENVIRONMENT, **own}
        return run(f"{RIVALS}/pm2", *words, env=variables).stdout

    def prepare(self) -> None:
        self.control("start", "dora", "--name", NAME, "--interpreter", "none", *self.arguments())
        self.control("stop", NAME)

    def arguments(self) -> tuple[str, ...]:
        """Of the app."""
        return ("--", "run", str(self.flow))

    def daemon_pids(self) -> list[int]:
        return [int((HOME / "pm2/pm2.pid").read_text())]

    def close(self) -> None:
        self.control("kill")


BARE = (Doractl, DoraRun, DoraUp, SystemdRun)
ALL = (*BARE, Supervisord, Circus, Pm2)


@contextmanager
def prepared(kinds: tuple[type[Contestant], ...], flow: Path) -> Iterator[list[Contestant]]:
    """All of them, warm, and gone afterwards."""
    with ExitStack() as stack:
        contestants = [kind(flow) for kind in kinds]
        for one in contestants:
            one.prepare()
            stack.callback(one.close)
        yield contestants


def processes_of_dora() -> set[int]:
    """Coordinators and daemons, of whomever."""
    pids = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
    return {pid for pid in pids if {"coordinator", "daemon"} & set(command_line(pid)[1:3])}


def child_of(parent: int) -> int:
    """The one child of a process."""
    found = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    assert len(found) == 1, f"children of {parent}: {found}"
    return int(found[0])
