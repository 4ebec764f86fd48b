"""How a runner exits: doractl reads this, and none of the states and actions of cells."""

from enum import IntEnum


class RunnerExit(IntEnum):
    """Exit status of the runner, which systemd shows as ExecMainStatus; see sysexits(3head)."""

    OK = 0
    FAILED = 1
    NO_MACHINE = 68
    ENGINE_LOST = 69
    NODES_FAILED = 70
    FAILED_AT_STOP = 71
    NO_DORA = 72
    STOPPED_ON_MACHINE = 73
    RESTARTS_SPENT = 75
    NO_ACCESS = 77
    BAD_DATAFLOW = 78
