"""`doractl setup`: installs or removes the files that the Debian package has and pip lacks."""

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.files import read_text
from dora_systemd.adapters.host.process import run_command
from dora_systemd.adapters.host.unit_files import (
    foreign_file,
    read_unit_file,
    remove_empty,
    remove_unit_file,
    write_link,
    write_unit_file,
)
from dora_systemd.adapters.releases.store import store_root
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.gateway.place import SERVICE_UNIT
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.unit.setup_files import (
    PACKAGED_UNIT,
    SYSTEM_ROOT,
    SetupFile,
    is_ours,
    setup_files,
    with_interpreter,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import name_from_unit
from dora_systemd.scope import Scope, config_home, home_of
from dora_systemd.values import shown
from dora_systemd.verbs.facts.enabled import own_directories

_PACKAGE = Path(__file__).parents[1]
_CHECKOUT = {"templates": "units/templates", "completions": "packaging/completions"}
_SECONDS = 60.0
_STANDARD = ("etc", "lib", "share", "man", "local")
"""Directories that exist on every machine, and are not removed."""


@dataclass(frozen=True)
class Step:
    """One file: its path, its text, and its current content."""

    file: SetupFile
    path: Path
    text: str
    present: str | None

    @property
    def is_done(self) -> bool:
        """Whether the file is in place."""
        return self.present == (self.file.link or self.text)


def plan_setup(scope: Scope, root: Path | None = None, package: Path = _PACKAGE) -> list[Step]:
    """Every file with its current content.

    Raises DoraSystemdError for a foreign file, and for a doractl that a Debian package has
    installed: that has the files elsewhere, and dpkg removes them.
    """
    source = _directory("man", package)
    if not source.is_dir():
        message = "cannot install or remove the files of a package"
        hint = "apt remove dora-systemd; apt reinstall dora-systemd installs them again"
        raise DoraSystemdError(message, hint)
    manuals = [path.name for path in source.iterdir()]
    place = root or data_root(scope)
    return [_step(file, place / file.place) for file in setup_files(scope.is_user, manuals)]


def put_in_place(steps: Sequence[Step]) -> list[Path]:
    """Write the missing files; their paths. Raises DoraSystemdError."""
    missing = [step for step in steps if not step.is_done]
    for step in missing:
        if step.file.link:
            write_link(step.path, step.file.link)
        else:
            write_unit_file(step.path, step.text)
    return [step.path for step in missing]


def take_away(steps: Sequence[Step]) -> list[Path]:
    """Remove our files, and directories that become empty; the paths."""
    there = [step for step in steps if step.present is not None]
    for step in there:
        remove_unit_file(step.path)
        for directory in takewhile(lambda one: one.name not in _STANDARD, step.path.parents):
            remove_empty(directory)
    return [step.path for step in there]


def data_root(scope: Scope) -> Path:
    """The root of all files. Raises DoraSystemdError for a user without a home directory."""
    if not scope.is_user:
        return Path(SYSTEM_ROOT)
    given = os.environ.get("XDG_DATA_HOME", "")
    if given.startswith("/"):
        return Path(given)
    if home := home_of(os.environ):
        return Path(home, ".local/share")
    raise DoraSystemdError("cannot find your home directory", "set HOME, or XDG_DATA_HOME")


def packaged_unit(scope: Scope) -> str:
    """The file that shows that a package has installed all this, or ""."""
    path = Path(PACKAGED_UNIT.replace("/system/", "/user/") if scope.is_user else PACKAGED_UNIT)
    return str(path) if path.exists() else ""


def leave_no_state(scope: Scope) -> None:
    """Remove the directories of the system's releases, unless there are releases in them."""
    place = store_root()
    for directory in () if scope.is_user else (place, place.parent):
        remove_empty(directory)


def refuse_if_needed(reach: Callable[[Scope], Manager], scope: Scope) -> None:
    """Raise DoraSystemdError while dora.target starts dataflows at boot.

    reach: opens the connection. Without systemd the usual directory of unit files is read.
    """
    links = _boot_directory(reach, scope).glob(f"{BOOT_TARGET}.wants/*")
    names = sorted(filter(None, (name_from_unit(link.name) for link in links)))
    if names:
        raise DoraSystemdError(
            f"cannot remove dora.target: a boot starts {', '.join(names)} with it",
            f"doractl {scope.flag} disable {' '.join(names)}",
        )


def _boot_directory(reach: Callable[[Scope], Manager], scope: Scope) -> Path:
    """The directory of the admin's (or user's) unit files."""
    try:
        return own_directories(reach(scope), scope)[0]
    except DoraSystemdError as error:
        if error.code is not ExitCode.NO_SYSTEMD:
            raise
    of_user = Path("/", config_home(os.environ), "systemd/user")
    return of_user if scope.is_user else Path("/etc/systemd/system")


def tell_systemd(
    reach: Callable[[Scope], Manager], scope: Scope, written: Sequence[Path] = ()
) -> tuple[str, ...]:
    """Have systemd load the changes; warnings about what failed.

    reach: opens the connection. Without systemd, as in an image build, the next boot loads them.
    written: the new files. A gateway of the old ones ends; the next connection starts the new one.
    """
    with contextlib.suppress(DoraSystemdError):
        manager = reach(scope)
        manager.reload()
        if any(path.name == SERVICE_UNIT for path in written):
            manager.run_jobs("StopUnit", [SERVICE_UNIT])
    if scope.is_user or scope.uid:
        return ()
    state = ["systemd-tmpfiles", "--create", f"--prefix={store_root().parent}"]
    commands = (["systemd-sysusers"], state, ["journalctl", "--update-catalog"])
    return tuple(filter(None, map(_run, commands)))


def unsearched(reach: Callable[[Scope], Manager], scope: Scope) -> tuple[str, ...]:
    """A warning if a user's systemd does not search the directory in which the units are now."""
    if not scope.is_user:
        return ()
    with contextlib.suppress(DoraSystemdError):
        if reach(scope).read(BOOT_TARGET, ["LoadState"])["LoadState"] == "not-found":
            place = shown(str(data_root(scope)))
            hint = "unset XDG_DATA_HOME for setup, or set it for systemd, too"
            return (f"systemd does not search {place} for units: {hint}",)
    return ()


def _run(command: Sequence[str]) -> str:
    try:
        done = run_command(command, _SECONDS)
    except DoraSystemdError as error:
        return error.message
    reason = (done.stderr.strip().splitlines() or [str(exit_of(done.status))])[-1]
    return f"{' '.join(command)}: {reason}" if done.status else ""


def _step(file: SetupFile, path: Path) -> Step:
    if not file.link:
        present = read_unit_file(path)
        if present is not None and not is_ours(present):
            raise foreign_file(path)
        return Step(file, path, text_of(file), present)
    link = str(path.readlink()) if path.is_symlink() else None
    if link not in (None, file.link) or (link is None and path.exists()):
        raise foreign_file(path)
    return Step(file, path, "", link)


def text_of(file: SetupFile) -> str:
    """The text of a file; units run the Python interpreter of this process."""
    text = read_text(_directory(file.source[0]) / file.source[1])
    return with_interpreter(text, sys.executable)


def _directory(kind: str, package: Path = _PACKAGE) -> Path:
    """The directory of the files of one kind, in the installed package or in a checkout."""
    in_checkout = package.parent / _CHECKOUT.get(kind, f"packaging/{kind}")
    return package / kind if (package / kind).is_dir() else in_checkout
