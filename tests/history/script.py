"""A history as a script that anyone can run, as root on a machine with nothing else on it. Pure."""

from collections.abc import Sequence

from tests.history.steps import FAULTS, LOOK, Step, shell_of

_HEAD = """#!/bin/bash
# Needs doractl, dora, and a project with dataflow.yml in $WORK/{cells}/project,
# where `python -m tests.history --project DIRECTORY` puts it.
export WORK=${{WORK:-/var/tmp/history}}
"""
_LOOK = """thaw; wait; {undo}
until [ -z "$(systemctl list-jobs --no-legend 'dora-*')" ]; do sleep 0.2; done
doractl list --all; doractl why $name"""


def format_script(steps: Sequence[Step], preamble: str) -> str:
    """The text of the script."""
    cells = "{" + ",".join(sorted({step.cell for step in steps})) + "}"
    lines = [_HEAD.format(cells=cells), preamble]
    undo: list[str] = []
    is_stopped = False
    for place, step in enumerate(steps):
        if step.what == LOOK:
            lines.append(_LOOK.format(undo="; ".join([*undo, ":"])))
            undo.clear()
            is_stopped = False
            continue
        undo += _undo_of(step)
        is_next_joined = place + 1 < len(steps) and steps[place + 1].is_joined
        lines.append(_line(step, is_next_joined, is_stopped))
        is_stopped = step.what == "stop-doractl" or (is_stopped and step.is_joined)
    return "\n".join(lines) + "\n"


def _undo_of(step: Step) -> list[str]:
    fault = FAULTS.get(step.what)
    return [f"of {step.cell}; {fault.undo}"] if fault and fault.undo else []


def _line(step: Step, is_next_joined: bool, is_stopped: bool) -> str:
    """is_stopped: a doractl may be stopped, for which `wait` would wait for ever."""
    pause = f"sleep {step.pause_ms / 1000:g}; " if step.pause_ms else ""
    wait = "" if step.is_joined else "thaw; wait; " if is_stopped else "wait; "
    shell = f"{{ {shell_of(step.what)}; }}"
    return f"{wait}{pause}of {step.cell}; {shell}{' &' if is_next_joined else ''}"
