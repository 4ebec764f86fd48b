"""System scope or user scope: selects the manager and its directories."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

RUNTIME_NAME = "dora-systemd"
NOTICE_NAME = "dora-systemd-notice"
"""The directory with a directory for each dataflow that has on_failure, see systemd.path(5)."""


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
        home, given = os.environ.get("HOME", ""), os.environ.get("XDG_STATE_HOME", "")
        return Path(given if given.startswith("/") else f"{home}/.local/state")

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


def scope_of(is_user: bool | None) -> Scope:
    """The requested scope; the default is the system's for root, else the user's."""
    uid = os.getuid()
    return Scope(is_user=uid != 0 if is_user is None else is_user, uid=uid)


def config_home(environment: Mapping[str, str]) -> str:
    """A user's directory of configuration, or "" if the variables name none.

    As systemd does, this ignores a relative path in XDG_CONFIG_HOME, see sd_path_lookup(3).
    """
    home, given = environment.get("HOME", ""), environment.get("XDG_CONFIG_HOME", "")
    if given.startswith("/"):
        return given
    return f"{home}/.config" if home.startswith("/") else ""
