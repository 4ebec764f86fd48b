"""The faults: how each comes about, under which flags, what becomes of the dataflow, how soon."""

import signal
from dataclasses import dataclass

from tests.system.faults import apply
from tests.system.faults.apply import Apply
from tests.system.faults.checks import Outcome

ON_FAILURE = ("--restart-policy", "on-failure")
ALWAYS = ("--restart-policy", "always")
WATCHED = (*ON_FAILURE, "--property", "WatchdogSec=2s")
SHORT_GRACE = (*ON_FAILURE, "--grace-duration", "1s")

LOST = (
    *("code=killed", "Failed with result", "status=69", "is lost", "failed: ", "was killed ("),
    *(
        "disconnected",
        "exited",
        "connection error",
        "channel closed",
    ),
)
CRASHED = (
    *("crashed", "node exited with error", "exit code", "signal", "restarted", "after failure"),
)
HUNG = (*LOST, "no heartbeat", "atchdog", "Killing process", "SIGABRT", "core-dump", "dumped")
UNRESPONSIVE = (*CRASHED, "hang", "unresponsive", "SIGKILL", "Signal(9)")
KILLED = ("grace period", "killed on drop", "node exited with error")


@dataclass(frozen=True)
class Fault:
    """One line of the table.

    seconds: within which the outcome is there. cause: what the journal says, and `list` of a
    dataflow that has failed. warns: what the journal of the unit may warn of. answers: seconds of
    an idle machine after which dora ends a node that does not answer; 0 for never. repeats: lines
    that may be in the journal twice. vm: needs controllers, or a kernel of its own. prepare: what
    is done before the start.
    """

    name: str
    apply: Apply
    outcome: Outcome
    seconds: float
    cause: str = ""
    flags: tuple[str, ...] = ON_FAILURE
    warns: tuple[str, ...] = ()
    answers: float = 0
    repeats: int = 0
    vm: bool = False
    prepare: Apply | None = None


KILL, TERM, STOP = signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP
UNAFFECTED, DORA, SYSTEMD = Outcome.UNAFFECTED, Outcome.DORA, Outcome.SYSTEMD
ENDED, FAILED = Outcome.ENDED, Outcome.FAILED

PARTS = (
    Fault(
        "kill-runner", apply.part("runner", KILL), SYSTEMD, 12, "SIGKILL", warns=LOST, repeats=20
    ),
    Fault("term-runner", apply.part("runner", TERM), ENDED, 5),
    Fault(
        *("stop-runner", apply.part("runner", STOP), SYSTEMD, 15, "hung", WATCHED, HUNG),
        repeats=20,
    ),
    Fault("kill-coordinator", apply.part("coordinator", KILL), SYSTEMD, 12, "SIGKILL", warns=LOST),
    Fault("term-coordinator", apply.part("coordinator", TERM), SYSTEMD, 12, "SIGTERM", warns=LOST),
    Fault(
        *("stop-coordinator", apply.part("coordinator", STOP), SYSTEMD, 15, "does not answer"),
        *(WATCHED, HUNG),
    ),
    Fault("kill-daemon", apply.part("daemon", KILL), SYSTEMD, 12, "SIGKILL", warns=LOST),
    Fault(
        *("stop-daemon", apply.part("daemon", STOP), SYSTEMD, 40, "does not answer"),
        *(WATCHED, HUNG),
    ),
    Fault("term-daemon", apply.part("daemon", TERM), SYSTEMD, 12, "SIGTERM", warns=LOST),
)
NODES = (
    Fault("kill-node", apply.nodes(KILL, "doubler"), DORA, 12, "SIGKILL", warns=CRASHED),
    Fault("term-node", apply.nodes(TERM, "doubler"), DORA, 12, "SIGTERM", warns=CRASHED),
    Fault(
        *("stop-node", apply.nodes(STOP, "doubler"), DORA, 20, "hangs"),
        warns=UNRESPONSIVE,
        answers=2,
    ),
    Fault("kill-nodes", apply.all_nodes(KILL), DORA, 12, "SIGKILL", warns=CRASHED),
    Fault("term-nodes", apply.all_nodes(TERM), DORA, 12, "SIGTERM", warns=CRASHED),
    Fault(
        *("stop-nodes", apply.all_nodes(STOP), DORA, 20, "hangs"),
        warns=UNRESPONSIVE,
        answers=2,
    ),
    Fault("node-exits-0", apply.death("source", "exit0"), ENDED, 8, "finished"),
    Fault("node-exits-0-always", apply.death("sink", "exit0"), DORA, 12, "", ALWAYS, CRASHED),
    Fault("node-exits-1", apply.death("sink", "exit1"), DORA, 12, "exit code 1", warns=CRASHED),
    Fault("node-aborts", apply.death("sink", "abort"), DORA, 12, "SIGABRT", warns=CRASHED),
    Fault("node-leaves-child", apply.death("sink", "leave-child"), DORA, 12, warns=CRASHED),
    Fault("node-daemonises", apply.death("sink", "daemonise"), DORA, 12, warns=CRASHED),
    Fault("node-ignores-stop", apply.stubborn, ENDED, 8, "", SHORT_GRACE, KILLED),
    Fault(
        *("node-spins", apply.order("sink", "spin"), DORA, 20, "hangs"),
        warns=UNRESPONSIVE,
        answers=2,
    ),
    Fault("node-floods", apply.order("sink", "flood"), UNAFFECTED, 30),
)
MACHINE = (
    Fault("journald-restarts", apply.restarted("systemd-journald.service"), UNAFFECTED, 5),
    Fault("daemon-reexec", apply.command("systemctl", "daemon-reexec"), UNAFFECTED, 5),
    Fault("daemon-reload", apply.command("systemctl", "daemon-reload"), UNAFFECTED, 5),
    Fault("reexec-in-start", apply.reexec_in_start, SYSTEMD, 15, "SIGKILL", warns=LOST),
    Fault(
        "directory-deleted",
        apply.delete_directory,
        SYSTEMD,
        20,
        "is gone",
        warns=(*LOST, "cannot write"),
    ),
    Fault(
        *("project-read-only", apply.read_only_project, DORA, 12, "SIGKILL"),
        warns=CRASHED,
        prepare=apply.mount_project,
    ),
    Fault("disk-full", apply.fill_out, DORA, 12, "SIGKILL", warns=CRASHED),
    Fault("kill-all", apply.kill_unit, SYSTEMD, 12, "SIGKILL", warns=LOST, repeats=20),
)

OWN_KERNEL = (
    Fault(
        *("node-fork-bombs", apply.fork_bomb, DORA, 120, "exit code 1"),
        *((*ON_FAILURE, "--node=sink:tasks_limit=100"), CRASHED),
        vm=True,
    ),
    Fault("clock-forward", apply.clock(3600), UNAFFECTED, 60, vm=True),
)

TABLE = (*PARTS, *NODES, *MACHINE, *OWN_KERNEL)
