"""Checks whether the recorder can run on this machine."""

import os

from dora_systemd.adapters.dora.probe import probe_python
from dora_systemd.decisions.cell.launch import LaunchPlan
from dora_systemd.decisions.recorder.record import check_memory

_PURPOSE = "record outputs"


def recorder_python(plan: LaunchPlan) -> str:
    """The absolute path of a Python with dora-rs. Raises DoraSystemdError (BAD_INPUT)."""
    return probe_python(plan, purpose=_PURPOSE)


def total_memory() -> int:
    """Bytes of memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_recorder(plan: LaunchPlan) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the recorder has no Python, or no memory."""
    record = plan.options.of_dataflow("record")
    if record is not None:
        check_memory(record, total_memory())
        recorder_python(plan)
