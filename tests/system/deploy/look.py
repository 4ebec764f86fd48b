"""What runs and what is left of a killed deploy, seen without the help of doractl."""

import fcntl
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.releases.store import HISTORY
from dora_systemd.names import is_release_id
from tests.system.cells import Cell, command_line, wait_for
from tests.system.releases import ETC, STORE, Releases, differences


class Look(NamedTuple):
    """current: the release that every start runs. ran: the one whose supervisor process is there.

    left: what nothing needs. wrong: what must not be.
    """

    current: str
    ran: str
    left: tuple[Path, ...]
    wrong: tuple[str, ...]


def look(releases: Releases) -> Look:
    """What there is when the dataflow is up or down."""
    wait_for("nobody changes it", lambda: _is_free(releases), 120)
    wait_for("it is up or down", lambda: _is_settled(releases.cell), 120)
    current, ran = release_in(ETC / releases.cell.unit), running(releases)
    trial, left = release_in(releases.trial), tuple(sorted({*_left(releases)}))
    wrong = []
    if ran not in (current, trial) or not ran:
        wrong.append(f"{ran or 'nothing'} runs, not {current} nor {trial or 'a trial'}")
    if releases.trial.exists():
        wrong.append("a trial survives")
    for directory in releases.path.iterdir():
        if is_release_id(directory.name) and directory not in left:
            wrong += [f"{directory.name}: {path}" for path in differences(directory)]
    return Look(current, ran, left, tuple(wrong))


def running(releases: Releases) -> str:
    """The release in the command line of the supervisor process, "" without one."""
    pid = int(releases.cell.show("MainPID"))
    return _release(" ".join(command_line(pid))) if pid else ""


def release_in(unit_file: Path) -> str:
    """The release in a unit file, "" without one."""
    return _release(unit_file.read_text()) if unit_file.exists() else ""


def unnamed(releases: Releases, left: tuple[Path, ...]) -> Iterator[str]:
    """What `doctor` should name and does not."""
    said = releases.cell.doractl("doctor", check=False).stdout if left else ""
    for path in left:
        words = "on trial" if path == releases.trial else str(path)
        # A temporary file of a unit file may be about to get its name for a minute.
        if words not in said and path.parent not in (ETC, releases.trial.parent):
            yield f"doctor does not name {path}"


def kind(path: Path) -> str:
    """A thing that is left, in words without a number."""
    if path.suffix == ".service":
        return "trial"
    if is_release_id(path.name):
        return "copy without a unit file"
    words = {".new": "draft", ".old": "removed one"}
    return words.get(path.name[:4], "temporary file")


def age(left: tuple[Path, ...]) -> None:
    """Let files that may be about to get their names be older than they are."""
    for path in left:
        if path.is_file():
            os.utime(path, (0, 0))


def _is_free(releases: Releases) -> bool:
    """Whether no doractl and no child of one holds the lock of the store."""
    with (STORE / f".{releases.cell.name}.lock").open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


def _is_settled(cell: Cell) -> bool:
    job = ("show", "--property", "ActiveState,Job")
    said = dict(line.split("=") for line in cell.systemctl(*job).splitlines())
    return said["ActiveState"] in ("active", "failed", "inactive") and not said.get("Job")


def _left(releases: Releases) -> Iterator[Path]:
    unit = releases.cell.unit
    for one in releases.path.iterdir():
        if one.name == HISTORY:
            continue
        if one.name.startswith(".") or not (one / "unit").exists():
            yield one
    for place in (ETC, releases.trial.parent):
        yield from place.glob(f".{unit}.*")
    if release_in(releases.trial) not in ("", release_in(ETC / unit)):
        yield releases.trial


def _release(text: str) -> str:
    found = re.search(r"/releases/[^/ ]+/([^/ ]+)/tree/", text)
    return found[1] if found else ""
