"""LAB=machines: three booted containers on a bridge. The command runs in the first.

Each has a disk of its own, which outlives a power cut: an overlay on the image. A socket in the
first, /lab/control, takes one line for a change of what lies between them:

    cable NAME on|off|mute    a pulled cable, or packets that get lost further on
    power NAME on|off         off is a power cut

and answers "ok" or what went wrong.
"""

import os
import socket
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from lab import cgroup
from lab.container import (
    Container,
    enter_command,
    hide_traces,
    insert_disk,
    nspawn_words,
    place_checkout,
    start_nspawn,
    wait_ready,
)
from lab.errors import LabError
from lab.network import Network, address, call
from lab.options import Options
from lab.process import die_with_parent, need_tools
from lab.runs import Run, note, remove_cgroup
from lab.terminal import kept_terminal

NAMES = ("a", "b", "c")
FIRST = NAMES[0]
INTERFACE = "lan"
ALICE = 1000

_FURNISH = """
set -eu
ssh-keygen -A >/dev/null
rm /etc/systemd/system/ssh.service
systemctl enable --quiet ssh.service lab-lan.service
# bash reads it for each command by ssh, too, and the completion in it takes longer than the rest.
sed -i '1i case $- in *i*) ;; *) return ;; esac' /root/.bashrc
install -d -m 700 /root/.ssh
install -d -o alice -g alice -m 700 /home/alice/.ssh
[ -e /root/.ssh/id_ed25519 ] || ssh-keygen -q -t ed25519 -N '' -f /root/.ssh/id_ed25519
"""
_LAN = """[Unit]
Before=network.target ssh.service
Wants=network.target
[Service]
Type=oneshot
RemainAfterExit=yes
ExecStart=/usr/sbin/ip address add {address}/24 dev {interface}
ExecStart=/usr/sbin/ip link set {interface} up
[Install]
WantedBy=multi-user.target
"""
_SSHD = """PermitRootLogin prohibit-password
PasswordAuthentication no
SetEnv PATH=/opt/lab/bin:/usr/bin:/bin
"""


def run_in_machines(run: Run, tree: Path, options: Options) -> int:
    need_tools("systemd-nspawn", "ip")
    if len(options.commands) > 1:
        raise LabError("reboot three machines at once", "power, see tests/machines/wires.py")
    hide_traces(run)
    place_checkout(run.directory / "src")
    with built(run, tree, options.out) as machines, kept_terminal():
        container = machines[FIRST].container
        assert container
        return subprocess.run(enter_command(container, options), check=False).returncode


@contextmanager
def built(run: Run, tree: Path, out: Path | None) -> Iterator[dict[str, "Machine"]]:
    """All machines, booted, while the caller's block runs."""
    network = Network(run.directory / "network")
    machines = {name: Machine(run, name, network) for name in NAMES}
    try:
        furnish(machines, tree)
        control = made(run.directory / "lab") / "control"
        machines[FIRST].binds = [(run.directory / "src", "/src"), (control.parent, "/lab")]
        machines[FIRST].binds += [(out, "/out")] if out else []
        for one in machines.values():
            one.binds = one.binds or [(run.directory / "src", "/src")]
            one.power_on()
        with Control(control, machines):
            yield machines
    finally:
        for one in machines.values():
            one.power_off()


@dataclass
class Machine:
    """A machine, switched off at first."""

    run: Run
    name: str
    network: Network
    binds: list[tuple[Path, str]] = field(default_factory=list)
    container: Container | None = None
    _nspawn: subprocess.Popen[bytes] | None = None

    @property
    def place(self) -> Path:
        return self.run.directory / f"{self.run.name}-{self.name}"

    @property
    def root(self) -> Path:
        return self.place / "root"

    @property
    def cable(self) -> str:
        return f"cable-{self.name}"

    def power_on(self) -> None:
        inner = Run(self.place, self.run.lock)
        enter, path = cgroup.enter_command(inner.name)
        note(self.run, "cgroup", path)
        told = self.place / "notify"
        told.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
            ready.bind(str(told))
            self._nspawn = start_nspawn(inner, [*enter, *self._command(inner)])
            leader = wait_ready(ready, self._nspawn, inner, self.plug)
        self.container = Container(leader, path / "supervisor")

    def plug(self) -> None:
        """Before it has booted: an enabled dataflow may wait for the network until it has."""
        self.network.plug(self.cable)

    def power_off(self) -> None:
        """Nothing gets the time to say or write a word."""
        if self._nspawn is not None:
            path = cgroup.enter_command(self.place.name)[1]
            cgroup.note_usage(path)
            with suppress(FileNotFoundError):
                remove_cgroup(path)
            self._nspawn.kill()
            self._nspawn.wait()
            self._nspawn = self.container = None
            self.network.remove(self.cable)

    def _command(self, inner: Run) -> list[str]:
        words = [
            *nspawn_words(inner, self.root, self.name),
            f"--network-veth-extra={self.cable}:{INTERFACE}",
            *(f"--bind={outside}:{inside}" for outside, inside in self.binds),
        ]
        return die_with_parent([*self.network.enter_command(), *words])


def furnish(machines: dict[str, Machine], tree: Path) -> None:
    """Disks, addresses, and root of the first as root and alice of all, by ssh."""
    hosts = [f"{address(number)} {name}" for number, name in enumerate(machines)]
    for number, one in enumerate(machines.values()):
        insert_disk(one.place, tree)
        etc = one.root / "etc"
        (etc / "hostname").write_text(f"{one.name}\n")
        (etc / "hosts").write_text("\n".join(["127.0.0.1 localhost", "::1 localhost", *hosts, ""]))
        lan = _LAN.format(address=address(number), interface=INTERFACE)
        (etc / "systemd/system/lab-lan.service").write_text(lan)
        (etc / "ssh/sshd_config.d/lab.conf").write_text(_SSHD)
        (etc / "machine-id").write_text(f"{number + 1:032x}\n")
        call(["chroot", str(one.root), "sh", "-c", _FURNISH])
    acquaint(list(machines.values()))


def acquaint(machines: Sequence[Machine]) -> None:
    """Root of the first knows the others' host keys, and all know its key."""
    home = machines[0].root / "root/.ssh"
    key = (home / "id_ed25519.pub").read_text()
    known = ""
    for one in machines:
        for user, number in (("root", 0), ("home/alice", ALICE)):
            file = one.root / user / ".ssh/authorized_keys"
            file.write_text(key)
            os.chown(file, number, number)
        known += f"{one.name} {(one.root / 'etc/ssh/ssh_host_ed25519_key.pub').read_text()}"
    (home / "known_hosts").write_text(known)


class Control:
    """Carries out what the first machine asks for, while its block runs."""

    def __init__(self, place: Path, machines: dict[str, Machine]) -> None:
        self._machines = machines
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.bind(str(place))
        self._socket.listen()

    def __enter__(self) -> "Control":
        threading.Thread(target=self._serve, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:  # closed
                return
            with client, client.makefile("rw") as lines:
                lines.write(f"{self._carry_out(lines.readline().split())}\n")

    def _carry_out(self, words: list[str]) -> str:
        try:
            what, name, how = words
            one = self._machines[name]
            actions = {
                ("cable", "on"): lambda: one.network.plug(one.cable),
                ("cable", "off"): lambda: one.network.unplug(one.cable),
                ("cable", "mute"): lambda: one.network.mute(one.cable),
                ("power", "on"): one.power_on,
                ("power", "off"): one.power_off,
            }
            actions[what, how]()
        except (ValueError, KeyError) as error:
            return f"not understood: {error}"
        except LabError as error:
            return str(error)
        return "ok"


def made(path: Path) -> Path:
    path.mkdir(mode=0o755, parents=True, exist_ok=True)
    return path
