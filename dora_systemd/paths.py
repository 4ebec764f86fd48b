"""The files of one cell: what lies where in the RuntimeDirectory of its unit."""

from pathlib import Path
from typing import NamedTuple


class CellPaths(NamedTuple):
    """The RuntimeDirectory `root` (mode 0700, see RuntimeDirectory= in systemd.exec(5)) by name."""

    root: Path

    @property
    def is_of_user(self) -> bool:
        """Whether it belongs to a unit of a user's manager: below XDG_RUNTIME_DIR."""
        return self.root.is_relative_to("/run/user")

    @property
    def status(self) -> Path:
        """The live node table, replaced atomically by the runner."""
        return self.root / "status.json"

    @property
    def control(self) -> Path:
        """Port and token of the cell's coordinator, mode 0600: a note of the runner to itself."""
        return self.root / "control.json"

    @property
    def socket(self) -> Path:
        """Where the runner answers doractl, and relays to the coordinator."""
        return self.root / "runner.sock"

    @property
    def settings(self) -> Path:
        """The version of the dataflow's settings file that is in use."""
        return self.root / "settings.yml"

    @property
    def coordinator(self) -> Path:
        """Working directory of the coordinator, which writes its token and its log there."""
        return self.root / "coordinator"

    @property
    def daemon(self) -> Path:
        """Working directory of the daemon."""
        return self.root / "daemon"

    @property
    def work(self) -> Path:
        """Dora's working directory of the dataflow: its `out/` lands here, not in the project."""
        return self.root / "work"

    @property
    def io(self) -> Path:
        """The directory of the nodes' output pipes."""
        return self.root / "io"

    def node_stdout(self, node: str) -> Path:
        """The FIFO that is the standard output of `node`."""
        return self.io / f"{node}.out"

    def node_stderr(self, node: str) -> Path:
        """The FIFO that is the standard error of `node`."""
        return self.io / f"{node}.err"

    def node_place(self, node: str) -> Path:
        """How far dora's own log file of `node` is in the journal."""
        return self.io / f"{node}.place"

    def node_pid(self, node: str) -> Path:
        """Where the launcher of `node` notes its pid, before anything else it does."""
        return self.io / f"{node}.pid"
