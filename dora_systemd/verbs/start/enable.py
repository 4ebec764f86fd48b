"""`doractl enable` and `doractl disable`: the unit file that a boot finds.

A dataflow that runs goes on untouched. Its transient unit hides the file: systemd looks into
/run/systemd/transient first. Nobody may take that fragment away under a unit that is loaded:
systemd would delete the file in /etc in its place as soon as it forgets the unit.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import (
    changed_files,
    foreign_file,
    read_unit_file,
    remove_changes,
    remove_unit_file,
    wanted_units,
    write_unit_file,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.unit.file import (
    BOOT_TARGET,
    persistent_unit,
    plain_target,
    runner_of,
    without_install,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import own_directories

_FORGET_SECONDS = 2.0
_RETRY_SECONDS = 0.02


@dataclass(frozen=True)
class BootUnit:
    """The unit file of one dataflow, as far as there is one.

    path: where it is or would be. runtime: the same in the directory that a reboot empties.
    text, options: of the file at `path`, None without one. is_wanted: a target starts the unit.
    """

    unit: str
    path: Path
    runtime: Path
    text: str | None
    options: RunnerOptions | None
    is_wanted: bool

    @property
    def is_enabled(self) -> bool:
        """Whether a boot starts it."""
        return self.is_wanted and self.text is not None


def read_boot_unit(manager: Manager, scope: Scope, unit: str) -> BootUnit:
    """What there is of `unit` on disk. Raises DoraSystemdError (NAME_IN_USE) for foreign files."""
    lasting, fleeting = own_directories(manager, scope)
    path = lasting / unit
    text = read_unit_file(path)
    options = None if text is None else runner_of(text)
    if text is not None and (options is None or unit_name(options.name) != unit):
        raise foreign_file(path)
    return BootUnit(unit, path, fleeting / unit, text, options, unit in wanted_units(lasting))


def boot_target(manager: Manager, scope: Scope) -> str:
    """The target that starts dataflows: our own where it is set up and itself part of the boot."""
    facts = manager.read(BOOT_TARGET, ["LoadState", "WantedBy"])
    is_there = facts["LoadState"] == "loaded" and facts["WantedBy"]
    return BOOT_TARGET if is_there else plain_target(scope.is_user)


def enable_cell(manager: Manager, scope: Scope, cell: Cell) -> tuple[BootUnit, bool]:
    """Have every boot start this dataflow; its unit file, and whether that is news.

    Raises DoraSystemdError; then nothing has changed.
    """
    refuse_attached(cell)
    boot = read_boot_unit(manager, scope, cell.unit)
    if boot.is_enabled:
        return boot, False
    facts = manager.read(cell.unit, ["FragmentPath", "DropInPaths", "Transient"])
    fragment = Path(facts["FragmentPath"])
    if facts["Transient"] or fragment == boot.runtime:
        # What doractl set has changed is in drop-ins that are gone after a reboot.
        drop_ins = [one for one in map(Path, facts["DropInPaths"]) if one.is_relative_to("/run")]
        texts = [read_unit_file(path) or "" for path in (fragment, *drop_ins)]
        target = boot_target(manager, scope)
        text = persistent_unit(texts, cell.options, scope.is_user, target)
        install_unit_file(manager, boot, text)
    else:
        _link(manager, cell.unit, cell.unit)
    if not (facts["Transient"] and cell.is_up):
        remove_unit_file(boot.runtime)
        manager.reload()
    return boot, True


def refuse_attached(cell: Cell) -> None:
    """Raise DoraSystemdError for a dataflow of `doractl run`, which cannot outlive it."""
    if cell.options.attached:
        raise DoraSystemdError(
            f"cannot make a unit file of {cell.name}: it ends with the doractl run that it "
            "belongs to",
            "start it with doractl start",
            ExitCode.USAGE,
        )


def install_unit_file(manager: Manager, boot: BootUnit, text: str) -> None:
    """Write the unit file and link it; on failure all is as it was. Raises DoraSystemdError."""
    write_unit_file(boot.path, text)
    try:
        _link(manager, str(boot.path), boot.unit)
    except DoraSystemdError as error:
        if boot.text is None:
            remove_unit_file(boot.path)
        else:
            write_unit_file(boot.path, boot.text)
        raise _no_link(boot.unit) if error.code is ExitCode.NOT_FOUND else error from error


def _no_link(unit: str) -> DoraSystemdError:
    """What systemd calls a missing unit: it could not make the directory of the link."""
    hint = f"is there room on the disk? see systemctl enable {unit}"
    return DoraSystemdError(f"cannot enable {unit}: systemd made no link to it", hint)


def disable_cell(manager: Manager, scope: Scope, cell: Cell) -> bool:
    """The opposite of enable_cell: links and unit file go; False if there was nothing to do.

    What runs from the file runs on: until the next boot its text is in the runtime directory.
    """
    boot = read_boot_unit(manager, scope, cell.unit)
    if not boot.is_wanted and boot.text is None:
        return False
    facts = manager.read(cell.unit, ["FragmentPath", "ActiveState"])
    is_in_use = facts["FragmentPath"] == str(boot.path) and facts["ActiveState"] != "inactive"
    if boot.text is not None and is_in_use:
        changes = [read_unit_file(path) or "" for path in changed_files(boot.path)]
        write_unit_file(boot.runtime, without_install("\n".join([boot.text, *changes])))
    manager.disable_unit_files([cell.unit])
    remove_unit_file(boot.path)
    remove_changes(boot.path)
    manager.reload()
    return True


def drop_unit_files(manager: Manager, boot: BootUnit) -> None:
    """Take away unit files that no boot uses: of a dataflow that was disabled, and does not run."""
    if boot.text is not None or boot.runtime.exists():
        for path in (boot.path, boot.runtime):
            remove_unit_file(path)
            remove_changes(path)
        manager.reload()


def release_transient(manager: Manager, boot: BootUnit) -> None:
    """Have systemd forget a transient unit that has ended, so that the enabled file counts.

    systemd forgets, with its fragment, what no target wants any more: for a moment none does.
    """
    manager.disable_unit_files([boot.unit])
    try:
        manager.reload()
        wait_until_forgotten(manager, boot.unit)
    finally:
        manager.enable_unit_files([str(boot.path)])
        manager.reload()


def wait_until_forgotten(manager: Manager, unit: str) -> None:
    """Wait until a transient unit is gone: systemd unloads it some time after nothing holds it."""
    deadline = time.monotonic() + _FORGET_SECONDS
    while manager.read(unit, ["Transient"])["Transient"]:
        if time.monotonic() > deadline:
            raise DoraSystemdError(
                f"cannot start {unit}: systemd still holds the ended one",
                f"systemctl list-dependencies --reverse {unit}",
                ExitCode.NAME_IN_USE,
            )
        time.sleep(_RETRY_SECONDS)


def _link(manager: Manager, name: str, unit: str) -> None:
    if not manager.enable_unit_files([name]):
        hint = f"systemctl edit {unit}: [Install] with WantedBy={BOOT_TARGET}"
        raise DoraSystemdError(f"cannot enable {unit}: it has no section [Install]", hint)
