"""`doractl restart` of what has ended."""

from collections.abc import Mapping

from dora_systemd.adapters.bus.manager import Manager, StageObserver
from dora_systemd.decisions.views.outcome import Outcome
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.again import Asked
from dora_systemd.verbs.start.job import start_unit
from dora_systemd.verbs.start.launch import claim
from dora_systemd.verbs.start.plan import StartRequest


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
        return Outcome(asked, "", "; ".join(filter(None, (error.message, error.hint))))
    return Outcome(asked, f"Dataflow restarted: {asked.uuid} ({asked.name})")
