"""The actions of the status page's buttons, and the data of its graph of a dataflow.

They take their time: a page may disconnect meanwhile, and the gateway may be stopped. They run in
threads, which no signal reaches.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.adapters.host.notify import extend_timeout
from dora_systemd.decisions.cell.extra import without_extra
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.gateway.page_messages import HOT_RELOAD, PageMessage, graph_values
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.values import SECOND
from dora_systemd.verbs.facts.cells import Cell
from dora_systemd.verbs.facts.locks import require_uninhibited
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.facts.selector import Selector
from dora_systemd.verbs.node import ask_coordinator
from dora_systemd.verbs.reload import check_hot_reload, reload_cell, switch_hot_reload
from dora_systemd.verbs.restart import act_on, told
from dora_systemd.verbs.set import set_limits
from dora_systemd.verbs.start.enable import disable_cell, enable_cell
from dora_systemd.verbs.start.logins import ensure_linger
from dora_systemd.verbs.start.read import written_dataflow
from dora_systemd.verbs.start.restart_ended import find_start
from dora_systemd.verbs.start.start import restart_asked

_LONGER = 30 * SECOND
"""µs from each step of an action on that systemd gives the gateway to end, if it has to. Without
that it would kill the gateway while a dataflow with a long grace duration stops."""


class Action:
    """An action under way. must_end: the gateway is about to end, and the action does not know."""

    def __init__(self, all_of_them: "Actions") -> None:
        self.must_end = False
        self._all = all_of_them

    def go_on(self, _step: object = None) -> None:
        """Raise DoraSystemdError, once, if the gateway is about to end."""
        self._all.hold_on()
        if self.must_end:
            self.must_end = False  # the way back has to be gone to its end
            raise _stopped()


class Actions:
    """All actions of a gateway. extend: requests so many µs more for its stop from systemd."""

    def __init__(self, extend: Callable[[int], object] = extend_timeout) -> None:
        self._extend = extend
        self._under_way: set[Action] = set()
        self._ending = threading.Event()

    @contextmanager
    def acting(self) -> Iterator[Action]:
        """Run an action, during which the gateway does not exit as idle.

        Raises DoraSystemdError if the gateway is about to end, and so begins no more actions.
        """
        action = Action(self)
        self._under_way.add(action)
        try:
            if self._ending.is_set():
                raise _stopped()
            yield action
        finally:
            self._under_way.discard(action)

    @property
    def is_acting(self) -> bool:
        """Whether any action is under way."""
        return bool(self._under_way)

    def hold_on(self) -> None:
        """Keep systemd from killing a gateway that ends while an action is under way."""
        if self._ending.is_set():
            self._extend(_LONGER)

    def end(self) -> None:
        """Have all actions end soon, and refuse new ones."""
        self._ending.set()  # first: one that begins now is in the set, or sees this
        for action in list(self._under_way):
            action.must_end = True


ACTIONS = Actions()
"""The actions of this process."""


def _stopped() -> DoraSystemdError:
    return DoraSystemdError("the gateway was stopped", "it starts again with the next connection")


_BY = "status page"


def act(scope: Scope, message: PageMessage, manager: Manager | None = None) -> str:
    """Carry out an action on a dataflow or one of its nodes; what was done, for the page.

    manager: None for a new connection to systemd. Raises DoraSystemdError as the verbs of doractl
    do.
    """
    if message.action == "bundle":
        return _write_bundle(scope, message.dataflow)
    bus = manager or Bus(scope)
    known = find_start(bus, scope, Selector(message.dataflow))
    if message.action == "rollback":
        return _roll_back(bus, scope, known.name, message.release)
    if isinstance(known, Cell):
        return _ACTIONS[message.action](bus, scope, known, message)
    if message.action in ("start", "restart") and not message.node:
        return told(restart_asked(bus, scope, known, os.environ, None, _BY))
    what = f"{known.name}: it has ended"
    if message.node:
        what = f"node {message.node}: {known.name} has ended"
    raise DoraSystemdError(f"cannot {message.action} {what}", f"doractl start {known.name}")


def _act(manager: Manager, scope: Scope, cell: Cell, message: PageMessage) -> str:
    # Only what has ended can be started, and a restart does that.
    action = "stop" if message.action == "stop" else "restart"
    return act_on(manager, scope, cell, message.node, action, by=_BY)


def _enable(manager: Manager, scope: Scope, cell: Cell, _message: PageMessage) -> str:
    _refuse_on_trial(scope, cell, "enable")
    boot, is_news = enable_cell(manager, scope, cell)
    done = f"Dataflow{'' if is_news else ' already'} enabled: {cell.uuid} ({cell.name})"
    return _joined(done, str(boot.path), ensure_linger(scope))


def _disable(manager: Manager, scope: Scope, cell: Cell, _message: PageMessage) -> str:
    _refuse_on_trial(scope, cell, "disable")
    done = disable_cell(manager, scope, cell)
    return f"Dataflow {'disabled' if done else 'not enabled'}: {cell.uuid} ({cell.name})"


def _reload(_manager: Manager, scope: Scope, cell: Cell, message: PageMessage) -> str:
    require_uninhibited(scope, [cell], "reload")
    return _joined(*reload_cell(scope, cell, message.node or None)) or "Nothing has changed"


def _set(manager: Manager, scope: Scope, cell: Cell, message: PageMessage) -> str:
    _refuse_on_trial(scope, cell, "set")
    limits, switch = dict(message.values), message.values.get(HOT_RELOAD)
    limits.pop(HOT_RELOAD, None)
    if switch is not None:
        check_hot_reload(cell, switch == "on")
    done: list[str] = []
    if limits or switch is None:
        warnings = set_limits(manager, scope, cell, limits)
        done += [f"Limits changed: {cell.uuid} ({cell.name})", *warnings]
    if switch is not None:
        switch_hot_reload(manager, scope, cell, switch == "on")
        done.append(f"Hot reload {switch}: {cell.uuid} ({cell.name})")
    return _joined(*done)


def _refuse_on_trial(scope: Scope, cell: Cell, verb: str) -> None:
    # Imported late: few change a unit, and its imports are memory.
    from dora_systemd.verbs.releases.listing import refuse_on_trial

    refuse_on_trial(scope, cell, verb)


def _roll_back(manager: Manager, scope: Scope, name: str, release: str) -> str:
    # Imported late: few roll back, and its imports are memory.
    from dora_systemd.verbs.releases.rollback import roll_back

    with ACTIONS.acting() as action:
        done = roll_back(manager, scope, name, release or None, 0, action.go_on, by=_BY)
    how = f"runs release {done.release}" if done.release else "has ended its trial"
    return f"Dataflow rolled back: {done.uuid} ({name}) {how}"


def _write_bundle(scope: Scope, uuid: str) -> str:
    # Imported late: few write one, and its imports are memory.
    from dora_systemd.verbs.bundles.write import write_bundle

    done = write_bundle(partial(Bus, for_reading=True), scope, uuid, _BY)
    missing = (f"not in the bundle: {one}" for one in done.errors)
    return _joined(f"Bundle written: {done.path.name} ({done.name})", *missing)


def _joined(*texts: str) -> str:
    return "; ".join(filter(None, texts))


_ACTIONS: dict[str, Callable[[Manager, Scope, Cell, PageMessage], str]] = {
    **dict.fromkeys(("stop", "start", "restart"), _act),
    "enable": _enable,
    "disable": _disable,
    "reload": _reload,
    "set": _set,
}


def read_graph(scope: Scope, uuid: str) -> dict[str, Any]:
    """Nodes and edges of a dataflow. Raises DoraSystemdError if there is no readable descriptor.

    dora's own copy is what runs, with modules expanded; the file may have changed since the start.
    """
    cell = Selector(uuid).find(Bus(scope, for_reading=True))
    path = cell.options.dataflow
    running = _running_descriptor(scope, cell)
    return graph_values(parse_dataflow(running, path) if running else written_dataflow(path))


def _running_descriptor(scope: Scope, cell: Cell) -> object:
    """dora's copy without the nodes that the runner has added, or None if no run has one."""
    run = read_status(scope, cell).run if cell.has_begun else ""
    # The dataflow may be ending at this moment.
    with suppress(DoraSystemdError, KeyError, TypeError):
        if run:
            reply = ask_coordinator(scope, cell, {"Info": {"dataflow_uuid": run}})
            if isinstance(reply.result, dict) and not reply.error:
                running = reply.result["DataflowInfo"]["descriptor"]
                return {**running, "nodes": without_extra(running["nodes"])}
    return None
