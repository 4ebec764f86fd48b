"""Finds a Python with dora-rs for the probe and the recorder, see decisions/owes/ and recorder/."""

import os
import sys
from collections.abc import Iterator, Sequence

from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.cell.launch import LaunchPlan, python_of
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.trust.programs import own_account

_SECONDS = 60.0
_FIND = """
import importlib.util, sys
sys.path[:1] = [one for one in sys.path[:1] if one]
spec = importlib.util.find_spec(sys.argv[1])
sys.exit(1) if spec is None or spec.origin is None else print(sys.executable)
"""
"""Prints the interpreter if it has the module. It does not import it, which takes longer."""


def probe_python(
    plan: LaunchPlan, module: str = "dora", purpose: str = "watch what nodes owe"
) -> str:
    """The absolute path of a Python with dora-rs: that of the nodes, else that of the runner.

    module: the name by which nodes import dora-rs. purpose: for the error. Blocks for some 20 ms.
    Raises DoraSystemdError (BAD_INPUT) if there is none.
    """
    for command in _interpreters(plan):
        if found := _with_module(command, plan, module):
            return found
    python = " ".join(next(_interpreters(plan)))
    raise bad_input(
        f"cannot {purpose}: {python} has no dora-rs",
        "run: pip install dora-rs there, or give another environment with --venv",
    )


def _interpreters(plan: LaunchPlan) -> Iterator[Sequence[str]]:
    yield ("uv", "run", "python") if plan.options.uv else (python_of(plan),)
    yield (sys.executable,)


def _with_module(command: Sequence[str], plan: LaunchPlan, module: str) -> str:
    directory = plan.options.working_directory
    try:
        done = run_command(
            [*command, "-c", _FIND, module], _SECONDS, plan.environment, directory, own_account()
        )
    except DoraSystemdError:
        return ""  # there is no such program
    return done.stdout.strip() if done.status == 0 else ""


_RECORDING = "record outputs"


def recorder_python(plan: LaunchPlan) -> str:
    """The absolute path of a Python with dora-rs. Raises DoraSystemdError (BAD_INPUT)."""
    return probe_python(plan, purpose=_RECORDING)


def total_memory() -> int:
    """Bytes of memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_recorder(plan: LaunchPlan) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the recorder has no Python, or no memory."""
    record = plan.options.of_dataflow("record")
    if record is not None:
        # Imported late: what owes outputs has no recorder in most cases.
        from dora_systemd.decisions.recorder.record import check_memory

        check_memory(record, total_memory())
        recorder_python(plan)
