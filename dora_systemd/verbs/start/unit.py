"""The unit of a plan: its properties for systemd, and its text."""

import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.groups import mount_point
from dora_systemd.adapters.dora.command import version_numbers
from dora_systemd.decisions.needs.words import needs_of
from dora_systemd.decisions.properties.assignments import (
    NOTHING_NEWER,
    Newer,
    Properties,
    unknown_keys,
    with_properties,
)
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.reload.watch_rules import DEFAULT_WATCH, unmatched_patterns
from dora_systemd.decisions.settings.limits import DEVICE
from dora_systemd.decisions.settings.needs import NEEDS
from dora_systemd.decisions.settings.resolve import idle_warnings
from dora_systemd.decisions.settings.table import PROPERTY
from dora_systemd.decisions.unit.file import persistent_unit
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION, drop_unsupported
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import CellPaths
from dora_systemd.trust.paths import exists
from dora_systemd.values import quoted
from dora_systemd.verbs.start.limits import check_limits
from dora_systemd.verbs.start.needs import Needy, check_needs, clock_service, needs_warnings
from dora_systemd.verbs.start.on_failure import check_units
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.read import key_place
from dora_systemd.verbs.start.sandbox import sandbox_warnings
from dora_systemd.verbs.start.startable import credential_files

if TYPE_CHECKING:
    from dora_systemd.decisions.machines.link_unit import LinkUnit


def plan_properties(plan: Plan, manager: Manager) -> tuple[dict[str, Property], tuple[str, ...]]:
    """Return all properties of the unit that this systemd supports, by slot, and warnings.

    The warnings are about unsupported properties, and limits above the machine's size. Raises
    DoraSystemdError.
    """
    needs, allowed = plan.settings[NEEDS], plan.settings[DEVICE]
    mount_point()  # no runner starts without cgroup v2
    check_needs(manager, Needy(plan.options.name, plan.scope.is_user, needs))
    number = systemd_number(manager)
    check_units(manager, plan.scope, plan.options)
    wanted = _properties(plan, lambda: manager)
    properties, warnings = drop_unsupported(wanted, number, plan.settings[PROPERTY])
    warnings = (
        *warnings,
        *passed_on(plan, number),
        *plan.warnings,
        *idle_warnings(plan.settings),
        *watch_warnings(plan),
        *needs_warnings(needs, needs_of(plan.options), plan.sandbox, allowed),
    )
    warnings = (*warnings, *sandbox_warnings(plan.sandbox))
    return properties, (*warnings, *check_limits(manager, plan, properties))


def passed_on(plan: Plan, systemd_version: int) -> Iterator[str]:
    """Yield a note for each property that only systemd can judge."""
    assignments = plan.settings[PROPERTY]
    for key in unknown_keys(assignments):
        yield f"{key}= is passed on as it is: only systemd {systemd_version} can judge it"


def _newer(plan: Plan, manager: Callable[[], Manager]) -> Newer:
    """Return the Newer that judges a --property that doractl does not know."""
    assignments = plan.settings[PROPERTY]
    if not unknown_keys(assignments):
        return NOTHING_NEWER
    asked = manager()
    return Newer(systemd_number(asked), asked.property_types())


def systemd_number(manager: Manager) -> int:
    """The version of systemd as a number; the oldest supported one if it has none."""
    return next(iter(version_numbers(manager.version())), MIN_VERSION)


def plan_links(plan: Plan) -> "list[LinkUnit]":
    """The units of the links to the members."""
    if not plan.members:
        return []
    # Imported late: most dataflows run on one machine.
    from dora_systemd.decisions.machines.link_unit import link_unit

    options, is_user = plan.options, plan.scope.is_user
    socket = str(CellPaths(plan.scope.cell_directory(options.name)).socket)
    place = key_place(plan.scope, os.environ)
    keys = {one.machine: str(path) for one in plan.members if exists(path := place / one.machine)}
    return [
        link_unit(sys.executable, socket, options, one, is_user, keys.get(one.machine, ""))
        for one in plan.members
    ]


def format_plan(plan: Plan, manager: Callable[[], Manager], target: str | None = None) -> str:
    """The unit as the text of a unit file, below comments with its name and sources.

    The units of links follow, whose ExecStart= contains the settings of members. target: would
    start the unit at boot.
    """
    head = f"# {plan.unit}\n# source: {plan.options.dataflow}\n"
    text = format_unit(_supported(_properties(plan, manager), manager))
    if target is not None:
        text = persistent_unit([text], plan.options, plan.scope.is_user, target)
    return head + text + "".join(_format_links(plan))


def _supported(properties: Properties, manager: Callable[[], Manager]) -> Properties:
    """Return the properties that this systemd supports; all of them without systemd."""
    try:
        number = systemd_number(manager())
    except DoraSystemdError:
        return properties
    return drop_unsupported(properties, number)[0]


def _format_links(plan: Plan) -> Iterator[str]:
    for member, link in zip(plan.members, plan_links(plan), strict=True):
        yield f"\n# {link.unit}\n# machine {member.machine}: {member.host.text}\n"
        yield format_unit(link.properties)


def _properties(plan: Plan, manager: Callable[[], Manager]) -> dict[str, Property]:
    context = UnitContext(
        python=sys.executable,
        is_user=plan.scope.is_user,
        user=None if plan.user is None else plan.user.pw_name,
        environment=plan.environment,
        credentials=credential_files(plan.settings),
        sandbox=plan.sandbox,
        clock=clock_service(),
        newer=_newer(plan, manager),
    )
    properties = dict(unit_properties(plan.options, context, plan.settings))
    if plan.members:
        # Imported late: most dataflows run on one machine.
        from dora_systemd.decisions.machines.link_unit import wanted_links

        return with_properties(properties, wanted_links(plan.options))
    return properties


def watched_patterns(plan: Plan) -> tuple[str, ...]:
    """The patterns of the files that cause a reload, empty without hot reload."""
    if not plan.options.hot_reload:
        return ()
    return plan.options.of_dataflow("watch") or DEFAULT_WATCH


def watch_warnings(plan: Plan) -> Iterator[str]:
    """A warning for each given pattern that matches no file.

    Only the owner of the files gets these: as root, doractl would search another user's
    directories.
    """
    if not plan.options.hot_reload or not plan.options.of_dataflow("watch") or _is_anothers(plan):
        return
    # Imported late: asyncio is slow to import, and only given patterns need a search.
    from dora_systemd.adapters.host.watch import watch_rules, watched_files

    rules = watch_rules(plan.options)
    for pattern in unmatched_patterns(rules, watched_files(rules)):
        yield f"no file below {rules.root} fits --watch {quoted(pattern)}"


def _is_anothers(plan: Plan) -> bool:
    return plan.user is not None and plan.user.pw_uid != os.geteuid()
