"""The steps from a request to a started unit that all ways of starting share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dora_systemd.adapters.bus.manager import Beside, Manager, Property, StageObserver
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.again import Asked, note_start
from dora_systemd.verbs.start.check import check_plan
from dora_systemd.verbs.start.claim import (
    place_unit_file,
    prepared_links,
    require_free_name,
    with_known_uuid,
)
from dora_systemd.verbs.start.job import start_unit
from dora_systemd.verbs.start.plan import Plan, StartRequest, make_plan, request_name
from dora_systemd.verbs.start.unit import plan_properties, systemd_number


@dataclass(frozen=True)
class Claim:
    """A dataflow whose name is free. properties, links: for start_unit()."""

    plan: Plan
    properties: Sequence[Property] | None
    warnings: tuple[str, ...]
    links: Beside = ()


def claim(
    manager: Manager,
    scope: Scope,
    request: StartRequest,
    command: str,
    want_boot: bool = False,
) -> Claim:
    """Check the request, prepare its unit and note the request, see again.py.

    command: by which it is asked. want_boot: as a unit file that is started at boot.

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
) -> Outcome:
    """Start what has ended once more, with the UUID and the settings it had, and wait for it.

    environment: the caller's variables.
    """
    try:
        request = asked.request(StartRequest(asked.dataflow, environment=environment))
        claimed = claim(manager, scope, request, "doractl restart")
        options = claimed.plan.options
        start_unit(manager, scope, options, claimed.properties, on_stage, True, claimed.links)
    except DoraSystemdError as error:
        return Outcome.of_error(asked, error)
    return Outcome(asked, f"Dataflow restarted: {asked.uuid} ({asked.name})")
