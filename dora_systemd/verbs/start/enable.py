"""`doractl enable` and `doractl disable`: the unit file that starts a dataflow at boot.

A running dataflow is not affected. Its transient unit takes precedence over the file, because
systemd looks into /run/systemd/transient first. Never remove that fragment while the unit is
loaded: systemd would delete the file in /etc instead when it unloads the unit.
"""

import os
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import Manager, queued_job
from dora_systemd.adapters.host.unit_files import (
    changed_files,
    foreign_file,
    put_unit_file,
    read_unit_file,
    remove_changes,
    remove_empty,
    remove_unit_file,
    sync_links,
    write_link,
    write_unit_file,
)
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.unit.file import (
    BOOT_TARGET,
    is_boot_checked,
    persistent_unit,
    plain_target,
    runner_of,
    without_install,
)
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import name_from_unit, notice_hold_unit, notice_unit, unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.enabled import own_directories, wanted_units

_FORGET_SECONDS = 2.0
_NOTICE_SECONDS = 30.0
"""TimeoutStartSec= of doranotice@.service."""
_HELD = ("Transient", "NFileDescriptorStore")
_RETRY_SECONDS = 0.02


class BootUnit(NamedTuple):
    """The unit file of one dataflow, if there is one."""

    unit: str
    path: Path  # where it is or would be
    runtime: Path  # its path in the directory that a reboot empties
    # text, options: of the file at `path`, None without a file
    text: str | None
    options: RunnerOptions | None
    is_wanted: bool  # a target starts the unit

    @property
    def is_enabled(self) -> bool:
        """Whether the dataflow is started at boot."""
        return self.is_wanted and self.text is not None

    @property
    def can_start(self) -> bool:
        """Whether it is enabled, by a unit file whose options this version knows."""
        return self.is_enabled and runner_of(self.text or "", can_start=True) is not None

    @property
    def is_checked(self) -> bool:
        """Whether a boot is good only if the dataflow comes up."""
        return self.is_enabled and is_boot_checked(self.text or "")


def read_boot_unit(manager: Manager, scope: Scope, unit: str) -> BootUnit:
    """The files of `unit`. Raises DoraSystemdError (NAME_IN_USE) for foreign files."""
    lasting, fleeting = own_directories(manager, scope)
    path = lasting / unit
    text = read_unit_file(path)
    options = None if text is None else runner_of(text)
    if text is not None and (options is None or unit_name(options.name) != unit):
        raise foreign_file(path)
    return BootUnit(unit, path, fleeting / unit, text, options, unit in wanted_units(lasting))


def boot_target(manager: Manager, scope: Scope) -> str:
    """The target that starts dataflows: our own if it is installed and part of the boot itself."""
    facts = manager.read(BOOT_TARGET, ["LoadState", "WantedBy"])
    is_there = facts["LoadState"] == "loaded" and facts["WantedBy"]
    return BOOT_TARGET if is_there else plain_target(scope.is_user)


def enable_cell(
    manager: Manager, scope: Scope, cell: Cell, is_checked: bool = False
) -> tuple[BootUnit, bool]:
    """Start this dataflow at every boot; its unit file, and whether that is a change.

    is_checked: from now on a boot is good only if the dataflow comes up; False leaves that as it
    is. Raises DoraSystemdError; then nothing has changed.
    """
    refuse_attached(cell)
    refuse_member(cell.options)
    _refuse_other_version(cell)
    if is_checked and scope.is_user:
        raise usage_error("cannot check the boot with a dataflow of a user", "use --system")
    boot = read_boot_unit(manager, scope, cell.unit)
    if boot.can_start and (boot.is_checked or not is_checked):
        return boot, False
    facts = manager.read(cell.unit, ["FragmentPath", "DropInPaths", "Transient"])
    texts = _present_texts(boot, facts, is_checked)
    if texts:
        target = boot_target(manager, scope)
        text = persistent_unit(texts, cell.options, scope.is_user, target, is_checked)
        links = _loaded_links(manager, scope, cell.options) if cell.options.placed else {}
        install_unit_file(manager, boot, text, links)
    else:
        _link(manager, cell.unit, cell.unit)
        sync_links(boot.path)
    if not (facts["Transient"] and cell.is_up):
        remove_unit_file(boot.runtime)
        manager.reload()
    return boot, True


def _present_texts(boot: BootUnit, facts: Mapping[str, Any], is_checked: bool) -> list[str]:
    """The unit as it is, from which its unit file is made; [] to use the file that exists.

    facts: FragmentPath, DropInPaths and Transient. Raises DoraSystemdError (NAME_IN_USE) for a
    foreign file that would have to be changed.
    """
    fragment = Path(facts["FragmentPath"])
    if not boot.can_start and (facts["Transient"] or fragment == boot.runtime):
        # Changes by doractl set are in drop-ins that a reboot removes: include them.
        drop_ins = [one for one in map(Path, facts["DropInPaths"]) if one.is_relative_to("/run")]
        return [read_unit_file(path) or "" for path in (fragment, *drop_ins)]
    if not is_checked:
        return []
    if boot.text is None:
        raise foreign_file(fragment)
    return [boot.text]


def refuse_attached(cell: Cell) -> None:
    """Raise DoraSystemdError for a dataflow of `doractl run`, which ends with that command."""
    if cell.options.attached:
        why = "it ends with the doractl run that it belongs to"
        raise no_unit_file(cell.name, why, code=ExitCode.USAGE)


def refuse_member(options: RunnerOptions) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a part of a dataflow: its head starts it."""
    if options.machine:
        there = f"on {options.head or 'head'}: doractl enable {options.name}"
        raise no_unit_file(options.name, "its head is another machine", there)


def _refuse_other_version(cell: Cell) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a dataflow whose unit this version cannot start."""
    if cell.options_problem:
        why = "another version of dora-systemd has started it"
        hint = f"doractl list {cell.name} says how to start this version"
        raise no_unit_file(cell.name, why, hint)


def _loaded_links(manager: Manager, scope: Scope, options: RunnerOptions) -> dict[str, str]:
    """The unit files of the links of a dataflow that systemd has loaded, by unit."""
    # Imported late: most dataflows run on one machine.
    from dora_systemd.decisions.machines.link_unit import (
        link_file,
        link_from_command,
        link_units_of,
    )

    found = {}
    for unit in link_units_of(options):
        commands = manager.read(unit, ["ExecStart"])["ExecStart"] or [("", ())]
        link = link_from_command(sys.executable, commands[0][1], options, scope.is_user)
        found[unit] = link_file(link)
    return found


def link_paths(boot: BootUnit, options: RunnerOptions | None) -> list[tuple[Path, Path]]:
    """The unit files of all links of a dataflow: where they last, and where a reboot ends them."""
    places = (boot.path, boot.runtime)
    return [(places[0].with_name(one), places[1].with_name(one)) for one in _links_of(options)]


def _links_of(options: RunnerOptions | None) -> list[str]:
    if options is None or not options.placed:
        return []
    from dora_systemd.decisions.machines.link_unit import link_units_of

    return list(link_units_of(options))


def no_unit_file(
    name: str,
    why: str,
    hint: str = "start it with doractl start",
    code: ExitCode = ExitCode.BAD_INPUT,
) -> DoraSystemdError:
    """The error for a dataflow of which no unit file can be made."""
    return DoraSystemdError(f"cannot make a unit file of {name}: {why}", hint, code)


def install_unit_file(
    manager: Manager, boot: BootUnit, text: str, links: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write the unit file and link it; undo both on failure. Raises DoraSystemdError.

    links: unit files of the links to other machines, by unit.
    """
    files = {boot.path.with_name(unit): of_link for unit, of_link in links.items()}
    with ExitStack() as undo:
        for path, content in {**files, boot.path: text}.items():
            before = read_unit_file(path)
            write_unit_file(path, content)
            undo.callback(put_unit_file, path, before)
        try:
            _link(manager, str(boot.path), boot.unit)
            sync_links(boot.path)
        except DoraSystemdError as error:
            raise _no_link(boot.unit) if error.code is ExitCode.NOT_FOUND else error from error
        undo.pop_all()


def _no_link(unit: str) -> DoraSystemdError:
    """The error for "not found" of systemd, which cannot create the directory of the link."""
    hint = f"is there room on the disk? see systemctl enable {unit}"
    return DoraSystemdError(f"cannot enable {unit}: systemd made no link to it", hint)


def disable_cell(manager: Manager, scope: Scope, cell: Cell) -> bool:
    """Undo enable_cell: remove the links and the unit file; False if there was nothing to do.

    A dataflow that runs from the file keeps running: its text is in the runtime directory until the
    next boot.
    """
    boot = read_boot_unit(manager, scope, cell.unit)
    if not boot.is_wanted and boot.text is None:
        return False
    facts = manager.read(cell.unit, ["FragmentPath", "ActiveState"])
    is_there = facts["ActiveState"] != "inactive" or cell.state.is_held
    is_in_use = facts["FragmentPath"] == str(boot.path) and is_there
    if boot.text is not None and is_in_use:
        changes = [read_unit_file(path) or "" for path in changed_files(boot.path)]
        for lasting, fleeting in link_paths(boot, boot.options):
            write_unit_file(fleeting, read_unit_file(lasting) or "")
        write_unit_file(boot.runtime, without_install("\n".join([boot.text, *changes])))
    manager.disable_unit_files([cell.unit])
    for lasting, _ in link_paths(boot, boot.options):
        remove_unit_file(lasting)
    remove_unit_file(boot.path)
    remove_changes(boot.path)
    manager.reload()
    return True


def drop_unit_files(manager: Manager, boot: BootUnit) -> None:
    """Remove unit files that are not needed: of a disabled dataflow that is not running."""
    if boot.text is not None or boot.runtime.exists():
        remove_files(manager, (boot.path, boot.runtime))


def remove_files(manager: Manager, paths: Sequence[Path]) -> None:
    """Remove unit files of dataflows, with those of their links, and their drop-ins."""
    for path in paths:
        links = _links_of(runner_of(read_unit_file(path) or ""))
        for one in (*map(path.with_name, links), path):
            remove_unit_file(one)
        remove_changes(path)
    manager.reload()


def release_transient(manager: Manager, boot: BootUnit) -> None:
    """Have systemd unload an ended transient unit, so that the enabled file takes effect.

    systemd unloads the unit, with its fragment, only while no target wants the unit. So links to
    /dev/null, which a reboot removes, hide those that enable the unit. Those stay on the disk:
    if this process is killed or the power fails, the dataflow is still enabled.
    """
    try:
        for mask in _masks(boot):
            write_link(mask, os.devnull)
        manager.reload()
        wait_until_forgotten(manager, boot.unit)
    finally:
        unmask(boot)
        manager.reload()


def unmask(boot: BootUnit) -> bool:
    """Remove what hides the links of a unit; whether there was any, as of a killed command."""
    masks = [one for one in _masks(boot) if one.is_symlink()]
    for mask in masks:
        remove_unit_file(mask)
        remove_empty(mask.parent)
    return bool(masks)


def _masks(boot: BootUnit) -> list[Path]:
    """The paths that have precedence over the links by which targets start a unit."""
    fleeting = boot.runtime.parent
    control = fleeting.with_name(f"{fleeting.name}.control")
    links = boot.path.parent.glob(f"*.wants/{boot.unit}")
    return sorted(control / link.parent.name / link.name for link in links)


def wait_until_forgotten(manager: Manager, unit: str, most: float = _FORGET_SECONDS) -> None:
    """Wait until a transient unit is gone: systemd unloads it a moment after the last reference.

    What FileDescriptorStorePreserve= keeps of it would keep the unit as well. So do the services
    that report a failure, until they have started; after that, systemd checks the unit only when
    unload() requests it.
    """
    begun = last = time.monotonic()
    while (facts := manager.read(unit, _HELD))["Transient"]:
        if facts["NFileDescriptorStore"]:
            manager.close_stored(unit)
        manager.unload(unit)
        now = time.monotonic()
        if now - last > most:
            if now - begun >= _NOTICE_SECONDS or not _is_held(manager, unit):
                raise DoraSystemdError(
                    f"cannot start {unit}: systemd still holds the ended one",
                    f"systemctl list-dependencies --reverse {unit}",
                    ExitCode.NAME_IN_USE,
                )
            last = now
        time.sleep(_RETRY_SECONDS)


def _is_held(manager: Manager, unit: str) -> bool:
    """Whether a service that reports a failure of the unit is to start, see verbs/notice/."""
    name = name_from_unit(unit) or ""
    services = (notice_unit(name), notice_hold_unit(name))
    return any(queued_job(manager.read(one, ["Job"])) for one in services)


def _link(manager: Manager, name: str, unit: str) -> None:
    if not manager.enable_unit_files([name]):
        hint = f"systemctl edit {unit}: [Install] with WantedBy={BOOT_TARGET}"
        raise DoraSystemdError(f"cannot enable {unit}: it has no section [Install]", hint)
