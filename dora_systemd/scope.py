"""System scope or user scope: selects the manager and its directories."""

import contextlib
import errno
import os
import pwd
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from dora_systemd.values import shell_word

RUNTIME_NAME = "dora-systemd"
NOTICE_NAME = "dora-systemd-notice"
"""The directory with a directory for each dataflow that has on_failure, see systemd.path(5)."""
_CONTAINER_MARKS = (".dockerenv", "run/.containerenv")
"""Files by which docker and podman mark a container."""

_SYSTEM_PLACES = ("/etc/", "/run/", "/usr/", "/var/")
"""Where the files of the system's dataflows are; those of a user are below HOME."""


class Scope(NamedTuple):
    """One systemd manager: the system's, or that of user `uid`."""

    is_user: bool
    uid: int

    @property
    def runtime_root(self) -> Path:
        """The parent of all RuntimeDirectory= of the manager, see systemd.exec(5)."""
        return Path(f"/run/user/{self.uid}") if self.is_user else Path("/run")

    @property
    def state_root(self) -> Path:
        """The parent of all StateDirectory= of the manager, see systemd.exec(5)."""
        if not self.is_user:
            return Path("/var/lib")
        given = os.environ.get("XDG_STATE_HOME", "")
        return Path(given if given.startswith("/") else f"{home_of(os.environ)}/.local/state")

    def cell_directory(self, name: str) -> Path:
        """The RuntimeDirectory of the unit of dataflow `name`."""
        return self.runtime_root / RUNTIME_NAME / name

    def notice_directory(self, name: str) -> Path:
        """The directory in which the runner of dataflow `name` requests a notice."""
        return self.runtime_root / NOTICE_NAME / name

    @property
    def transient_units(self) -> Path:
        """The directory of the manager's transient units, see systemd.unit(5)."""
        return self.runtime_root / "systemd/transient"

    @property
    def word(self) -> str:
        """The name of this scope."""
        return "user" if self.is_user else "system"

    @property
    def flag(self) -> str:
        """The option that selects this scope in systemctl, journalctl and doractl."""
        return f"--{self.word}"

    @property
    def is_callers(self) -> bool:
        """Whether the caller may read and change all of it: the caller is its user, or root."""
        return self.is_user or os.geteuid() == 0

    @property
    def command(self) -> str:
        """The command that acts in this scope, with sudo for a user who may not use the system's.

        Without an option where this scope is the default, see scope_of().
        """
        if self.is_user == bool(self.uid):
            return "doractl"
        return "doractl --user" if self.is_user else "sudo doractl"


def scope_of(is_user: bool | None) -> Scope:
    """The requested scope; the default is the system's for root, else the user's."""
    uid = os.getuid()
    return Scope(is_user=uid != 0 if is_user is None else is_user, uid=uid)


def home_of(environment: Mapping[str, str]) -> str:
    """The caller's home directory, or "" if there is none.

    As systemd does, this ignores a relative path in HOME, which would depend on the directory in
    which a command is typed.
    """
    if (given := environment.get("HOME", "")).startswith("/"):
        return given
    try:
        return pwd.getpwuid(os.getuid()).pw_dir
    except KeyError:
        return ""


def config_home(environment: Mapping[str, str]) -> str:
    """A user's directory of configuration, or "" if the variables name none.

    As systemd does, this ignores a relative path in XDG_CONFIG_HOME, see sd_path_lookup(3).
    """
    home, given = environment.get("HOME", ""), environment.get("XDG_CONFIG_HOME", "")
    if given.startswith("/"):
        return given
    return f"{home}/.config" if home.startswith("/") else ""


def without_systemd(root: Path = Path("/")) -> str:
    """Describe how to boot this machine with systemd; "" if it was. root: has all its files."""
    if (root / "run/systemd/system").is_dir():
        return ""
    try:
        kernel = (root / "proc/sys/kernel/osrelease").read_text(errors="replace").lower()
    except OSError:
        kernel = ""
    if "microsoft" in kernel:
        how = "write systemd=true below [boot] in /etc/wsl.conf, then run: wsl --shutdown"
        return f"WSL starts systemd only if told to: {how}"
    if any((root / mark).exists() for mark in _CONTAINER_MARKS):
        how = "boot it with /sbin/init, as podman run --systemd=always does, or use its host"
        return f"this container runs no systemd: {how}"
    return "this machine was not booted with systemd: make it the init system, and boot again"


def place_hint(path: Path, error: OSError) -> str:
    """Describe what to do if a file of doractl's own cannot be written at `path`."""
    if error.errno == errno.EROFS:
        return "the file system is mounted read-only"
    is_refused = isinstance(error, PermissionError)
    if str(path).startswith(_SYSTEM_PLACES):
        return "use sudo, or --user for a dataflow of your own" if is_refused else "see df"
    if is_refused and _is_in_own_home(path):
        return f"a directory above it belongs to another user: namei -l {shell_word(str(path))}"
    if is_refused or isinstance(error, FileNotFoundError | NotADirectoryError):
        return f"HOME is {home_of(os.environ)!r}: use one in which you can write"
    return "see df"


def _is_in_own_home(path: Path) -> bool:
    home = Path(home_of(os.environ))
    with contextlib.suppress(OSError):
        return path.is_relative_to(home) and home.stat().st_uid == os.getuid()
    return False
