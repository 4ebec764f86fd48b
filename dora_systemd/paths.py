"""The files of one cell, in the RuntimeDirectory of its unit; the directories of unit files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import NOTICE_NAME

_UNIT_PATH_HINT = "systemctl show --property UnitPath; is SYSTEMD_UNIT_PATH set for systemd?"

LAST_REQUEST = "last"
"""The file, in the directory of request_file(), of a runner whose dataflow has finally failed. The
runner ends when it is removed: then the ring of the recorder is open."""
TABLE = "status.json"
"""The live node table of a cell, in the RuntimeDirectory of its unit."""


def own_directory(environment: Mapping[str, str]) -> str:
    """The directory of the cell in RUNTIME_DIRECTORY, "" without one; see systemd.exec(5)."""
    return next((one for one in _directories(environment) if not _is_of_notices(one)), "")


def request_file(environment: Mapping[str, str]) -> Path | None:
    """The file by which a runner requests a notice, None if its dataflow has no on_failure."""
    directory = next(filter(_is_of_notices, _directories(environment)), None)
    return Path(directory, "request") if directory else None


def _directories(environment: Mapping[str, str]) -> list[str]:
    return environment.get("RUNTIME_DIRECTORY", "").split(":")


def _is_of_notices(directory: str) -> bool:
    return Path(directory).parent.name == NOTICE_NAME


class CellPaths:
    """Paths in the RuntimeDirectory `root` (mode 0700), see systemd.exec(5)."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.status = root / TABLE
        """The live node table, which the runner replaces atomically."""
        self.control = root / "control.json"
        """Port and token of the cell's coordinator, mode 0600; only the runner reads it."""
        self.socket = root / "runner.sock"
        """The socket where the runner answers doractl, and relays to the coordinator."""
        self.times = root / "times"
        """The times of the last messages of owed outputs, see decisions/owes/probe.py."""
        self.ring = root / "ring.sock"
        """The socket that hands out the memory of the recorder, see runner/recorder/."""
        self.settings = root / "settings.yml"
        """The version of the dataflow's settings file that is in use."""
        self.lock = root / "inhibit.lock"
        """The file that nodes and `doractl inhibit` lock to inhibit restarts, see flock(2)."""
        self.coordinator = root / "coordinator"
        """Working directory of the coordinator, which writes its token and log there."""
        self.daemon = root / "daemon"
        """Working directory of the daemon."""
        self.work = root / "work"
        """dora's working directory of the dataflow: keeps its `out/` out of the project."""
        self.launch = root / "launch"
        """On a member: how each of its nodes is started, see decisions/machines/part.py."""
        self.io = root / "io"
        """The directory of the nodes' output pipes."""

    @property
    def is_of_user(self) -> bool:
        """Whether the directory is of a user's manager, so below XDG_RUNTIME_DIR."""
        return self.root.is_relative_to("/run/user")

    def node_stdout(self, node: str) -> Path:
        """The FIFO for the standard output of `node`."""
        return self.io / f"{node}.out"

    def node_stderr(self, node: str) -> Path:
        """The FIFO for the standard error of `node`."""
        return self.io / f"{node}.err"

    def node_place(self, node: str) -> Path:
        """The position up to which dora's log file of `node` is in the journal."""
        return self.io / f"{node}.place"

    def node_notify(self, node: str) -> Path:
        """The notify socket of `node`, if it has one."""
        return self.io / f"{node}.notify"

    def node_gate(self, node: str) -> Path:
        """The FIFO that the launcher of `node` waits at, if the node has needs."""
        return self.io / f"{node}.gate"

    def node_pid(self, node: str) -> Path:
        """The file where the launcher of `node` first writes its pid."""
        return self.io / f"{node}.pid"


def unit_directories(
    search_path: Sequence[str], is_user: bool, runtime_root: str
) -> tuple[str, str]:
    """The directory of the admin's (or user's) unit files, and the one that a reboot empties.

    search_path: the manager's property UnitPath. runtime_root: a reboot empties everything below
    it. Raises DoraSystemdError.
    """
    ending = "/systemd/user" if is_user else "/systemd/system"
    fleeting = ("/run/", f"{runtime_root}/")
    places = (one for one in search_path if one.endswith(ending))
    lasting = next((one for one in places if not one.startswith(fleeting)), None)
    if lasting is None:
        raise DoraSystemdError(f"cannot find a directory {ending} for unit files", _UNIT_PATH_HINT)
    return lasting, runtime_root + ending
