"""The files of one cell, in the RuntimeDirectory of its unit."""

from pathlib import Path
from typing import NamedTuple


class CellPaths(NamedTuple):
    """Paths in the RuntimeDirectory `root` (mode 0700), see systemd.exec(5)."""

    root: Path

    @property
    def is_of_user(self) -> bool:
        """Whether the directory is of a user's manager, so below XDG_RUNTIME_DIR."""
        return self.root.is_relative_to("/run/user")

    @property
    def status(self) -> Path:
        """The live node table, which the runner replaces atomically."""
        return self.root / "status.json"

    @property
    def control(self) -> Path:
        """Port and token of the cell's coordinator, mode 0600; only the runner reads it."""
        return self.root / "control.json"

    @property
    def socket(self) -> Path:
        """The socket where the runner answers doractl, and relays to the coordinator."""
        return self.root / "runner.sock"

    @property
    def settings(self) -> Path:
        """The version of the dataflow's settings file that is in use."""
        return self.root / "settings.yml"

    @property
    def coordinator(self) -> Path:
        """Working directory of the coordinator, which writes its token and log there."""
        return self.root / "coordinator"

    @property
    def daemon(self) -> Path:
        """Working directory of the daemon."""
        return self.root / "daemon"

    @property
    def work(self) -> Path:
        """dora's working directory of the dataflow: keeps its `out/` out of the project."""
        return self.root / "work"

    @property
    def io(self) -> Path:
        """The directory of the nodes' output pipes."""
        return self.root / "io"

    def node_stdout(self, node: str) -> Path:
        """The FIFO for the standard output of `node`."""
        return self.io / f"{node}.out"

    def node_stderr(self, node: str) -> Path:
        """The FIFO for the standard error of `node`."""
        return self.io / f"{node}.err"

    def node_place(self, node: str) -> Path:
        """The position up to which dora's log file of `node` is in the journal."""
        return self.io / f"{node}.place"

    def node_pid(self, node: str) -> Path:
        """The file where the launcher of `node` first writes its pid."""
        return self.io / f"{node}.pid"
