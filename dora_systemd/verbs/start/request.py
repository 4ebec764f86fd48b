"""The request of a start: its first stage."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.errors import bad_input
from dora_systemd.names import name_from_path, parse_name
from dora_systemd.trust.paths import Place
from dora_systemd.values import shown

DEFAULT_FILE = "dataflow.yml"


class StartRequest(NamedTuple):
    """A request to start a dataflow."""

    dataflow: str
    name: str | None = None
    flags: Mapping[str, object] = {}  # raw, by name of the setting
    environment: Mapping[str, str] = {}  # the caller's variables
    attached: bool = False  # the dataflow ends with the caller
    uuid: str = ""  # of a dataflow that is started again
    # of `flags`, those that no earlier start has been accepted with, if there is a UUID
    changed: frozenset[str] = frozenset()
    # of a release, the file that its dataflow file was copied from: who owns that decides, not
    # root, who owns the copy
    origin: Place | None = None
    is_unbuilt: bool = False  # a build may make the programs of its nodes, see Plan.missing
    # machine, head, placed, addresses: of the runner's options, if this machine is a member of the
    # dataflow
    machine: str = ""
    head: str = ""
    placed: tuple[Placed, ...] = ()
    addresses: tuple[str, ...] = ()

    @property
    def search_path(self) -> str:
        """The PATH of the caller."""
        return self.environment.get("PATH") or os.defpath


def request_name(request: StartRequest) -> str:
    """The name of the dataflow. Raises DoraSystemdError (USAGE)."""
    if request.name is not None:
        return parse_name(request.name)
    return name_from_path(str(path_of(request)))


def path_of(request: StartRequest) -> Path:
    """Return the absolute path of the request. Raises DoraSystemdError (BAD_INPUT) if empty."""
    if not request.dataflow:  # not the working directory: a variable of a script is not set
        raise bad_input("cannot read '': no path", "name a file")
    try:
        return Path(request.dataflow).absolute()
    except FileNotFoundError as error:
        message = f"cannot read {shown(request.dataflow)}: the current directory was removed"
        raise bad_input(message, "cd to a directory that exists") from error


def current_directory() -> Path:
    """Return the current directory; "/" if it was removed: then no relative path was accepted."""
    try:
        return Path.cwd()
    except FileNotFoundError:
        return Path("/")
