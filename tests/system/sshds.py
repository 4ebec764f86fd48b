"""Servers of ssh on loopback addresses, and the configuration that leads root there."""

import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.system.cells import run, wait_for

HERE, HERS = "127.0.0.2", "127.0.0.3"
DEAD = "127.0.0.9"
PATH = "/opt/lab/bin:/usr/bin:/bin"
_SERVER = """
ListenAddress {address}:22
HostKey {place}/host
PidFile none
UsePAM yes
PasswordAuthentication no
KbdInteractiveAuthentication no
AuthorizedKeysFile {place}/key.pub
# The directory is in /var/tmp.
StrictModes no
PrintMotd no
{more}
"""
_HOST = """
Host {name}
    HostName {address}
    User {user}
    IdentityFile {place}/key
    IdentitiesOnly yes
    UserKnownHostsFile {known}
    StrictHostKeyChecking yes
"""


class Servers:
    """The hosts of one test, in `place`. known: by host key, how much root knows of a host."""

    def __init__(self, place: Path) -> None:
        self.place = place
        self.config = Path("/root/.ssh/config")
        self.config.parent.mkdir(mode=0o700, exist_ok=True)
        Path("/run/sshd").mkdir(exist_ok=True)
        for name in ("key", "host", "other"):
            run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(place / name))
        place.chmod(0o755)
        self._children: list[subprocess.Popen[bytes]] = []

    def serve(self, address: str, more: str = f"SetEnv PATH={PATH}") -> None:
        """Start a server there. more: lines of its configuration."""
        path = self.place / f"sshd-{address}"
        path.write_text(_SERVER.format(address=address, place=self.place, more=more))
        command = ["/usr/sbin/sshd", "-D", "-e", "-f", str(path)]
        with (self.place / f"log-{address}").open("wb") as log:
            self._children.append(subprocess.Popen(command, stderr=log))
        listening = ["ss", "-Hltn", f"src {address}:22"]
        wait_for("sshd", lambda: run(*listening).stdout)

    def name(self, name: str, address: str, user: str = "root", key: str = "host") -> None:
        """Let root call a host so. key: the host key that root knows; "" for none."""
        known = self.place / f"known-{name}"
        text = f"{address} {(self.place / f'{key}.pub').read_text()}" if key else ""
        known.write_text(text)
        words = {"name": name, "address": address, "user": user, "place": self.place}
        with self.config.open("a") as file:
            file.write(_HOST.format(known=known, **words))

    def end(self) -> None:
        """Stop the servers; no session may be left."""
        self.config.unlink(missing_ok=True)
        wait_for("no session is left", lambda: not sessions())
        for child in self._children:
            child.terminate()
            child.wait()


@contextmanager
def three_hosts() -> Iterator[Servers]:
    """The hosts base, which is root's, and arm, which is alice's; nobody listens at gone."""
    with tempfile.TemporaryDirectory(dir="/var/tmp") as place:
        servers = Servers(Path(place))
        for address in (HERE, HERS):
            servers.serve(address)
        servers.name("base", HERE)
        servers.name("arm", HERS, "alice")
        servers.name("gone", DEAD)
        yield servers
        servers.end()


def sessions() -> str:
    """The processes of doractl and of sessions over there."""
    found = run("ps", "-eo", "pid,args").stdout.splitlines()
    words = ("sshd-session", "bin/doractl")
    return "\n".join(one for one in found if any(word in one for word in words))


@contextmanager
def shell_of(user: str, shell: str, files: Mapping[str, str]) -> Iterator[None]:
    """Give an account a login shell, and files in its home directory that it reads."""
    before = run("getent", "passwd", user).stdout.strip().rpartition(":")[2]
    home = Path(f"~{user}").expanduser()
    kept = {name: (home / name).read_text() for name in files if (home / name).exists()}
    run("usermod", "--shell", shell, user)
    for name, text in files.items():
        # As that user: later tests write there as well.
        run("runuser", "-u", user, "--", "mkdir", "-p", str((home / name).parent))
        (home / name).write_text(text)
    try:
        yield
    finally:
        run("usermod", "--shell", before, user)
        for name in files:
            (home / name).unlink()
            if name in kept:
                (home / name).write_text(kept[name])
