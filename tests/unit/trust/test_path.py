"""Root runs no program that another user has put into PATH, whichever command needs one."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dora_systemd.adapters.journal.journalctl import journal_output
from dora_systemd.adapters.ssh import run_on_terminal, start_here, start_ssh
from dora_systemd.cli.verbs.look.logs import print_paged
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.machines.push import place_problem

pytestmark = pytest.mark.skipif(os.getuid() != 0, reason="becomes root")
NOBODY = 65534


@pytest.fixture
def has_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """What exists once a program of the first directory in PATH has run, which is nobody's."""
    programs, mark = place / "bin", place / "mark"
    programs.mkdir()
    for name in ("ssh", "sh", "journalctl", "less", "rsync"):
        program = programs / name
        program.write_text(f"#!/bin/sh\ntouch {mark}\n")
        program.chmod(0o755)
    os.chown(programs, NOBODY, NOBODY)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("TERM", "xterm")
    yield mark


DOORS: dict[str, Callable[[], object]] = {
    "ssh": lambda: start_ssh(["host"]),
    "ssh on a terminal": lambda: run_on_terminal(["host"]),
    "this machine": lambda: start_here("true"),
    "journalctl": lambda: list(journal_output(["--lines=1"])),
    "rsync": lambda: place_problem(Path("/usr"), ""),
    "a pager": lambda: print_paged(iter([b"line\n"])),
}


@pytest.mark.parametrize("door", DOORS)
def test_root_refuses_what_others_can_change(door: str, has_run: Path) -> None:
    refusal = r"cannot run \S+ as root: nobody can change it"
    with pytest.raises(DoraSystemdError, match=refusal) as one:
        DOORS[door]()
    assert one.value.code is ExitCode.NO_PERMISSION
    assert not has_run.exists()
