"""The steps from a request to a started unit that all ways of starting share.

The name of a new dataflow has to be free; what an ended one has left is removed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Beside, Manager, Property, StageObserver
from dora_systemd.adapters.host.unit_files import read_unit_file, remove_changes, remove_unit_file
from dora_systemd.decisions.properties.assignments import Properties
from dora_systemd.decisions.settings.table import USER
from dora_systemd.decisions.unit.file import persistent_unit, says_the_same, user_of
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.decisions.unit.systemd_versions import drop_unsupported
from dora_systemd.decisions.views.formats import local_time
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import release_of, unit_name
from dora_systemd.scope import Scope
from dora_systemd.values import shown
from dora_systemd.verbs.facts.cells import Cell, loaded_cell
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.enable import (
    BootUnit,
    boot_target,
    drop_unit_files,
    install_unit_file,
    link_paths,
    read_boot_unit,
    release_transient,
    unmask,
    wait_until_forgotten,
)
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.request import StartRequest, request_name
from dora_systemd.verbs.start.restart_ended import Asked, note_start
from dora_systemd.verbs.start.start_unit import start_unit
from dora_systemd.verbs.start.unit import plan_links, plan_properties, systemd_number


class Claim(NamedTuple):
    """A dataflow whose name is free."""

    plan: Plan
    # properties, links: for start_unit()
    properties: Sequence[Property] | None
    warnings: tuple[str, ...]
    links: Beside = ()


def claim(
    manager: Manager, scope: Scope, request: StartRequest, command: str, want_boot: bool = False
) -> Claim:
    """Check the request, prepare its unit and record the request, see restart_ended.py.

    command: that makes the request. want_boot: as a unit file that is started at boot.

    Raises DoraSystemdError; then nothing has changed.
    """
    boot = require_free_name(manager, scope, unit_name(request_name(request)))
    plan = with_known_uuid(make_plan(scope, request), boot)
    properties, warnings = plan_properties(plan, manager)
    if want_boot:
        # Check first: the unit file is written before a runner could refuse the dataflow.
        check_plan(lambda: manager, plan)
    has_file = place_unit_file(manager, plan, properties, boot, want_boot)
    note_start(plan, request, command)
    has_links = bool(plan.members) and not has_file
    links = prepared_links(manager, plan, systemd_number(manager)) if has_links else ()
    return Claim(plan, None if has_file else list(properties.values()), tuple(warnings), links)


def restart_asked(
    manager: Manager,
    scope: Scope,
    asked: Asked,
    environment: Mapping[str, str],
    on_stage: StageObserver | None,
    by: str,
) -> Outcome:
    """Start what has ended once more, with the UUID and the settings it had, and wait for it.

    environment: the caller's variables. by: what requests the start, for the journal.
    """
    try:
        request = asked.request(StartRequest(asked.dataflow, environment=environment))
        claimed = claim(manager, scope, request, by)
        options = claimed.plan.options
        start_unit(manager, scope, options, claimed.properties, on_stage, True, claimed.links)
    except DoraSystemdError as error:
        return Outcome.of_error(asked, error)
    return Outcome(asked, f"Dataflow restarted: {asked.uuid} ({asked.name})")


def require_free_name(manager: Manager, scope: Scope, unit: str) -> BootUnit:
    """Make sure that `unit` is not running, and change nothing; make_room() comes later.

    Returns the unit file, if there is one. Raises DoraSystemdError (NAME_IN_USE), which names what
    is running.
    """
    load = manager.read(unit, ["LoadState"])["LoadState"]
    cell = loaded_cell(manager, unit) if load == "loaded" else None
    if cell is not None and cell.is_up:
        raise _in_use(manager, cell)
    if cell is None and load != "not-found":
        raise DoraSystemdError(
            f"cannot start {unit}: a unit of that name already exists",
            f"see systemctl {scope.flag} cat {unit}; choose another --name",
            ExitCode.NAME_IN_USE,
        )
    return read_boot_unit(manager, scope, unit)


def make_room(manager: Manager, boot: BootUnit) -> None:
    """Have systemd unload an ended transient unit, and with it how that has ended.

    So only after everything that can refuse a start. Raises DoraSystemdError (NAME_IN_USE).
    """
    if manager.read(boot.unit, ["Transient"])["Transient"]:
        _forget(manager, boot)
    elif boot.text is None:
        return
    elif unmask(boot) or manager.read(boot.unit, ["LoadState"])["LoadState"] == "not-found":
        manager.reload()  # for "not-found" see lost_units()


def refuse_unit_file(boot: BootUnit) -> None:
    """Raise DoraSystemdError (NAME_IN_USE) if a dataflow of that name is started at boot."""
    if boot.is_enabled:
        raise DoraSystemdError(
            f"cannot use the name of {boot.unit}: it is enabled",
            "choose another --name",
            ExitCode.NAME_IN_USE,
        )


def require_same_user(verb: str, plan: Plan, present: str) -> None:
    """Raise DoraSystemdError (NAME_IN_USE) if a name would go from one user to another.

    A user chooses the name of a directory, and so must not get the name of another user's dataflow.
    present: User= of the unit with the name now, or "". Not checked with --uid, which decides.
    """
    user = "" if plan.user is None else plan.user.pw_name
    if present in ("", user) or plan.settings.is_given(USER):
        return
    name, path = plan.options.name, shown(plan.options.dataflow)
    raise DoraSystemdError(
        f"cannot {verb} {name}: the dataflow of that name is {present}'s, and {path} would run as "
        f"{user}",
        f"choose another --name, or give --uid {user} to replace it",
        ExitCode.NAME_IN_USE,
    )


def with_known_uuid(plan: Plan, boot: BootUnit) -> Plan:
    """Return the plan with the UUID of the enabled dataflow, if that is of the same file."""
    known = boot.options
    if not boot.is_enabled or known is None or known.dataflow != plan.options.dataflow:
        return plan
    members = (one.with_uuid(plan.options.uuid, known.uuid) for one in plan.members)
    options = plan.options._replace(uuid=known.uuid)
    return plan._replace(options=options, members=tuple(members))


def place_unit_file(
    manager: Manager, plan: Plan, properties: Properties, boot: BootUnit, want_boot: bool
) -> bool:
    """Whether to start the plan from a unit file, which then exists.

    want_boot: write the file in any case. Raises DoraSystemdError (NAME_IN_USE) if the dataflow is
    enabled with other settings.
    """
    has_file = want_boot or boot.text is not None
    text = _boot_text(manager, plan, properties, boot) if has_file else ""
    is_kept = boot.text is not None and boot.is_enabled and not want_boot
    links = _link_files(plan, systemd_number(manager)) if plan.members else {}
    is_same = says_the_same(text, boot.text or "") and all(
        read_unit_file(boot.path.with_name(unit)) == of_link for unit, of_link in links.items()
    )
    if is_kept and not is_same:
        raise _differs(plan.options.name, boot)
    if not is_kept and not want_boot:
        _refuse_deployed(plan.options.name, boot)
    if not is_kept:
        require_same_user("start", plan, user_of(boot.text or ""))
    make_room(manager, boot)
    if links:
        _forget_links(manager, plan.options.name)
    if want_boot:
        install_unit_file(manager, boot, text, links)
        old = set[Path]().union(*link_paths(boot, boot.options))
        for path in old.difference(boot.path.with_name(unit) for unit in links):
            remove_unit_file(path)
        remove_changes(boot.path)
        remove_unit_file(boot.runtime)
        manager.reload()
    elif not is_kept:
        drop_unit_files(manager, boot)
    return want_boot or is_kept


def _boot_text(manager: Manager, plan: Plan, properties: Properties, boot: BootUnit) -> str:
    """The unit file with which a boot would start the plan."""
    scope = plan.scope
    target, texts = boot_target(manager, scope), [format_unit(properties)]
    return persistent_unit(texts, plan.options, scope.is_user, target, boot.is_checked)


def _link_files(plan: Plan, systemd: int) -> dict[str, str]:
    """The unit files of the links to the members, by unit."""
    # Imported late: most dataflows run on one machine.
    from dora_systemd.decisions.machines.link_unit import link_file

    kept = (
        one._replace(properties=drop_unsupported(one.properties, systemd)[0])
        for one in plan_links(plan)
    )
    return {one.unit: link_file(one) for one in kept}


def prepared_links(manager: Manager, plan: Plan, systemd: int) -> Beside:
    """Prepare the links to the members of a plan; stop those of an ended dataflow of that name.

    Raises DoraSystemdError (NAME_IN_USE).
    """
    links = plan_links(plan)
    _forget_links(manager, plan.options.name)
    kept = ((one.unit, drop_unsupported(one.properties, systemd)[0]) for one in links)
    return [(unit, list(properties.values())) for unit, properties in kept]


def _forget_links(manager: Manager, name: str) -> None:
    for unit in end_links(manager, name):
        wait_until_forgotten(manager, unit)


def end_links(manager: Manager, name: str) -> list[str]:
    """Stop the links of a dataflow that has ended, and wait for that; their units.

    systemd does so as well, a moment later.
    """
    from dora_systemd.decisions.machines.link_unit import links_pattern

    there = [one.unit for one in manager.list_units(links_pattern(name))]
    if there:
        manager.run_jobs("StopUnit", there)
    return there


def _refuse_deployed(name: str, boot: BootUnit) -> None:
    """Raise DoraSystemdError (NAME_IN_USE) for the unit file of a release."""
    if boot.options is not None and (release := release_of(boot.options.dataflow)):
        raise DoraSystemdError(
            f"cannot start {name}: release {release} is deployed under that name",
            f"doractl restart {name} starts that one; or choose another --name",
            ExitCode.NAME_IN_USE,
        )


def _forget(manager: Manager, boot: BootUnit) -> None:
    manager.reset_failed(boot.unit)
    if boot.is_enabled:
        release_transient(manager, boot)
    else:
        wait_until_forgotten(manager, boot.unit)


def _in_use(manager: Manager, cell: Cell) -> DoraSystemdError:
    if cell.state.active == "deactivating":
        message = f"cannot start {cell.name}: dataflow {cell.uuid} of that name is stopping"
        hint = f"doractl stop {cell.name} waits for its end, or choose another --name"
        return DoraSystemdError(message, hint, ExitCode.NAME_IN_USE)
    since = manager.read(cell.unit, ["InactiveExitTimestamp"])["InactiveExitTimestamp"]
    does = "waits for its start" if cell.state.is_held else f"runs since {local_time(since)}"
    does = "waits for its restart" if cell.awaits_restart else does
    return DoraSystemdError(
        f"cannot start {cell.name}: dataflow {cell.uuid} of that name {does} "
        f"from {cell.options.dataflow}",
        f"doractl stop {cell.name}, or choose another --name",
        ExitCode.NAME_IN_USE,
    )


def _differs(name: str, boot: BootUnit) -> DoraSystemdError:
    return DoraSystemdError(
        f"cannot start {name}: it is enabled with other settings, in {boot.path}",
        f"doractl restart {name} starts that one, doractl start --enable replaces it",
        ExitCode.NAME_IN_USE,
    )
