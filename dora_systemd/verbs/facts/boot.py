"""Judges whether the dataflows that are started at boot can start, for `doractl doctor`."""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.unit_files import read_unit_file
from dora_systemd.decisions.unit.file import program_of, runner_of
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.decisions.views.rows import begin_anew
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import release_of
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import is_absent


def judge_enabled(path: Path, scope: Scope) -> Iterator[Finding]:
    """Yield what keeps an enabled unit file from starting its dataflow."""
    try:
        text = read_unit_file(path)
    except DoraSystemdError as error:
        yield Finding("boot", State.WARNING, error.message, error.hint)
        return
    options = runner_of(text or "")
    if text is None or options is None:
        broken = "is gone" if text is None else "starts no dataflow"
        remedy = f"systemctl {scope.flag} disable {path.name}"
        yield Finding("boot", State.WARNING, f"{path} is enabled and {broken}", remedy)
    elif is_absent(options.dataflow):
        text = f"{options.name} is enabled, but {options.dataflow} does not exist"
        yield Finding("boot", State.WARNING, text, f"doractl disable {options.name}")
    elif reason := _hindrance(text):
        found = f"{options.name} cannot start at boot: {reason}"
        release = release_of(options.dataflow)
        remedy = begin_anew(options.name, options.dataflow, release, is_enabled=True)
        yield Finding("boot", State.WARNING, found, remedy)


def _hindrance(text: str) -> str:
    """The reason why a unit file of ours cannot be executed, or ""."""
    if runner_of(text, can_start=True) is None:
        return "another version has enabled it"
    program = program_of(text)
    return f"{program} does not exist" if is_absent(program) else ""
