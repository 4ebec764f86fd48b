"""Why a dataflow has ended: the values of DORA_CAUSE in the journal and in `doractl why`."""

from enum import StrEnum

ESSENTIAL = "essential "
"""Begins the reason of dataflow-failed if the failure of one node has ended all. `why` reads it."""


NO_END = "its end is not recorded: it was killed, or the machine went down"
"""The text for an end without any record of its cause."""
RUNNER_KILLED = "the supervisor process was killed"
BY_SIGKILL = f"{RUNNER_KILLED} (SIGKILL)"
"""The text for a runner that was killed: by `stop --now`, another person, or a program."""


class Cause(StrEnum):
    """One reason for an end; NODE_SILENT and those up to OUT_OF_MEMORY occur in dataflow-failed."""

    NODE_FAILED = "node-failed"
    START_TIMEOUT = "start-timeout"
    REFUSED = "refused"
    BAD_DATAFLOW = "bad-dataflow"
    OTHER_VERSION = "other-version"
    DAEMON_LOST = "daemon-lost"
    COORDINATOR_LOST = "coordinator-lost"
    NO_ANSWER = "no-answer"
    MACHINE_LOST = "machine-lost"
    NO_MACHINE = "no-machine"
    MACHINE_REFUSES = "machine-refuses"
    STOPPED_ON_MACHINE = "stopped-on-machine"
    DIRECTORY_LOST = "directory-lost"
    RESTARTS_SPENT = "restarts-spent"
    RUNNER_BROKEN = "runner-broken"
    RUNNER_KILLED = "runner-killed"
    WATCHDOG = "watchdog"
    TIMEOUT = "timeout"
    OUT_OF_MEMORY = "out-of-memory"

    NODE_HUNG = "node-hung"
    NODE_WATCHDOG = "node-watchdog"
    NODE_SILENT = "node-silent"
    NODE_OUT_OF_MEMORY = "node-out-of-memory"
    UNIT_FAILED = "unit-failed"
    NO_END = "no-end"
    STOPPED = "stopped"
    FINISHED = "finished"
    NONE = ""


UNIT_RESULTS = {
    "timeout": (Cause.TIMEOUT, "it did not start or stop in time and was killed"),
    "watchdog": (Cause.WATCHDOG, "the supervisor process hung and was killed by the watchdog"),
    "oom-kill": (Cause.OUT_OF_MEMORY, "it ran out of memory"),
}
"""What a Result= of systemd means, see SERVICE_RESULT in systemd.exec(5)."""

_RESULTS = {
    "protocol": "its supervisor process ended without a message",
    "start-limit-hit": "it was started too often",
    "resources": "systemd could not set it up",
    "exec-condition": "a condition was not met",
}


def result_words(result: str) -> str:
    """Explain a Result= of systemd; "" if the exit of the main process explains more."""
    return UNIT_RESULTS[result][1] if result in UNIT_RESULTS else _RESULTS.get(result, "")
