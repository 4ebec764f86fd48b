"""The rows of `doractl list`: a field for each fact of a dataflow, and its key in JSON."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd import __version__
from dora_systemd.decisions.views.facts import USAGE, Fact, NodeRow
from dora_systemd.names import release_of
from dora_systemd.values import SECOND, shell_word


def begin_anew(name: str, file: str, release: str, is_enabled: bool, is_up: bool = True) -> str:
    """The commands after which systemd has a command line of the installed version for it."""
    if release:
        return "deploy its project again"
    start = f"doractl start {'--enable ' * is_enabled}--name {name} {shell_word(file)}"
    return f"doractl stop {name}, then {start}" if is_up else start


class Holder(NamedTuple):
    """A process that inhibits restarts of a dataflow."""

    pid: int  # 0 if it is not known
    user: str = ""
    command: str = ""
    node: str = ""  # of the dataflow to which the process belongs, or ""
    why: str = ""  # the reason that the process has written, or ""

    def values(self) -> dict[str, Any]:
        return {key: value or None for key, value in self._asdict().items()}


class Bundles(NamedTuple):
    """The bundles that failures of a dataflow have left, and those that were not written."""

    kept: int = 0
    newest: str = ""  # its path
    newest_at: int = 0  # CLOCK_REALTIME µs
    refused: int = 0
    refused_at: int = 0  # the last one that was not written, CLOCK_REALTIME µs
    reason: str = ""  # why that one was not written

    def values(self) -> dict[str, Any]:
        return {
            "kept": self.kept,
            "newest": self.newest or None,
            "refused": self.refused,
            "reason": self.reason or None,
        }


def format_bundles(bundles: Bundles | None, since_us: int = 0) -> str:
    """Format "/var/lib/.../robot-...-failed.tar and 2 more; 1 not written, the last: ...".

    since_us: "" if all is older. The time of a bundle is a whole second.
    """
    if bundles is None or max(bundles.newest_at + SECOND, bundles.refused_at) < since_us:
        return ""
    more = f" and {bundles.kept - 1} more" if bundles.kept > 1 else ""
    lost = f"{bundles.refused} not written, the last: {bundles.reason}" if bundles.refused else ""
    return "; ".join(filter(None, (f"{bundles.newest}{more}", lost)))


class DataflowRow(NamedTuple):
    """One row of `list`. uptime in µs; started, ended in CLOCK_REALTIME µs, 0: unknown.

    Other fields are as in NodeRow, for the whole dataflow.
    """

    uuid: str
    name: str
    unit: str
    status: str
    dataflow: str = ""
    text: str = ""
    uptime: int | None = None
    started: int = 0
    ready: int = 0
    ended: int = 0
    nodes_alive: int = 0
    nodes_total: int = 0
    cpu_percent: float | None = None
    memory: int | None = None
    memory_peak: int | None = None
    cpu_limit: float | None = None
    memory_limit: int | None = None
    throttled: float | None = None
    restarts: int | None = None
    restart_budget: Mapping[str, int | None] | None = None
    nodes: tuple[NodeRow, ...] = ()
    enabled: bool = False  # whether it is started at boot
    problem: str = ""  # why its node table is not valid, or ""
    inhibitors: tuple[Holder, ...] = ()  # who inhibits its restart
    listed_release: str = ""  # that in the Description= of its unit, for a row without `dataflow`
    needs: str = ""  # what systemd waits for before it starts the dataflow, or ""
    waits_since: int = 0  # since when systemd waits, CLOCK_REALTIME µs
    machines: tuple[str, ...] = ()  # the other machines that run nodes of the dataflow
    machine: str = ""  # the name of this machine if the head is elsewhere, or ""
    runner_version: str = ""  # of dora-systemd when it was started, "" if that is not known
    options_problem: str = ""  # why this doractl does not know all its options, or ""
    is_up: bool = True  # whether systemd has begun its start, or has the start in its queue
    bundles: Bundles | None = None  # of its failures; None if there are none to be read

    @property
    def release(self) -> str:
        """The release that it runs, "" if it was not deployed."""
        return release_of(self.dataflow) or self.listed_release

    @property
    def upgrade(self) -> tuple[str, str]:
        """Which other version of dora-systemd runs it, and what to do; "" if none does."""
        if self.options_problem:
            # A restart would start the same command line, which the installed runner refuses.
            todo = begin_anew(self.name, self.dataflow, self.release, self.enabled, self.is_up)
            return f"another version has started it: {self.options_problem}", todo
        if self.runner_version in ("", __version__):
            return "", ""
        text = f"runs {self.runner_version}, {__version__} is installed"
        return text, f"doractl restart {self.name}"


DATAFLOW_FACTS = (
    Fact("name", value=str),
    Fact("uuid", value=str),
    Fact("unit", value=str),
    Fact("file", "dataflow"),
    Fact("release"),
    Fact("status", value=str),
    Fact("waits_for", "needs"),
    Fact("waits_since", is_moment=True),
    Fact("text"),
    Fact("problem"),
    Fact("enabled"),
    Fact("inhibitors", value=lambda holders: [one.values() for one in holders]),
    Fact("uptime_us", "uptime"),
    Fact("started", is_moment=True),
    Fact("ready", is_moment=True),
    Fact("ended", is_moment=True),
    Fact("nodes_alive"),
    Fact("nodes_total"),
    *USAGE,
    Fact("waits_percent"),
    Fact("restarts"),
    Fact("restart_budget"),
    Fact("machine"),
    Fact("machines", value=list),
    Fact("runner_version"),
    Fact("options_problem"),
    Fact("bundles", value=lambda found: found.values() if found else None),
)
