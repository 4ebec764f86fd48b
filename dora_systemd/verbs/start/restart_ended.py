"""Starts an ended dataflow again, with its former settings.

systemd unloads a transient unit at its end. So each start writes its request to the journal, in the
name of the starting process; a later start by name makes its plan from that record.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.journal.note import note_request
from dora_systemd.decisions.logs.journal_events import FORGOTTEN
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import is_name, is_uuid, is_uuid_prefix, unit_name
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import exists, is_directory
from dora_systemd.values import quoted, shell_word
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.selector import Selector, selectors_of
from dora_systemd.verbs.start.request import DEFAULT_FILE, current_directory

if TYPE_CHECKING:
    from dora_systemd.verbs.start.plan import Plan
    from dora_systemd.verbs.start.request import StartRequest

EVENT = "start-asked"
COMMITTED = "release-committed"
_INIT = "1"
"""PID 1 adds LogExtraFields= of a unit to its own records, so the unit's owner writes in them."""


class Asked(NamedTuple):
    """A recorded request of a start."""

    name: str
    uuid: str
    dataflow: str
    flags: Mapping[str, object]  # as in StartRequest, with absolute paths

    @property
    def unit(self) -> str:
        return unit_name(self.name)

    def request(self, wanted: "StartRequest") -> "StartRequest":
        """Return the request for the recorded start, with the flags of `wanted` above its own.

        Raises DoraSystemdError (USAGE) for another name, or a wrong flag.
        """
        from dora_systemd.decisions.settings.resolve import given_texts, is_given

        if wanted.name not in (None, self.name):
            hint = f"doractl start {shell_word(self.dataflow)} --name NAME starts one more"
            raise usage_error(f"cannot start {self.name} as {quoted(wanted.name)}", hint)
        given = frozenset(key for key, value in wanted.flags.items() if is_given(value))
        flags = given_texts(wanted.flags, {}, current_directory(), self.flags)
        known = wanted._replace(dataflow=self.dataflow, name=self.name, uuid=self.uuid)
        return known._replace(flags=flags, changed=given)


def means_name(text: str) -> bool:
    """Whether the text is not that of a file: it can be a name, a unit or a UUID."""
    if "/" in text or text.endswith((".yml", ".yaml", ".json")):
        return False
    try:
        path = Path(text).absolute()
    except FileNotFoundError:
        return True  # the current directory was removed, and has no files
    return is_directory(path) or not exists(path)


def note_start(plan: "Plan", request: "StartRequest", command: str) -> None:
    """Write the request of a start to the journal. command: such as "doractl start"."""
    from dora_systemd.decisions.settings.resolve import given_texts

    options = plan.options
    note_request(
        EVENT,
        options.name,
        options.uuid,
        command,
        scope=plan.scope.word,
        file=options.dataflow,
        settings=json.dumps(given_texts(request.flags, request.environment, current_directory())),
    )


def find_asked(scope: Scope, selector: Selector) -> Asked | None:
    """The newest start of the dataflow that is meant; None if the journal has none.

    Raises DoraSystemdError if the journal cannot be read.
    """
    names = [f"DORA_DATAFLOW_NAME={name}" for name in filter(is_name, selector.names)]
    if names and (found := next(_asked(scope, names), None)):
        return found
    uuids = _asked(scope, []) if is_uuid_prefix(selector.text) else iter(())
    return next((one for one in uuids if selector.meant([one])), None)


def recorded_file(scope: Scope, name: str, uuid: str) -> str:
    """Return the file of an ended dataflow by the record of its start, or "" if that is unknown."""
    with suppress(DoraSystemdError):
        found = find_asked(scope, Selector(name))
        if found and found.uuid == uuid:
            _refuse_released(scope, found)
            return found.dataflow
    return ""


def find_known(
    manager: Manager, scope: Scope, texts: Sequence[str]
) -> tuple[list[Cell], list[Asked]]:
    """The dataflows that `texts` mean, each once: those systemd knows, and those that have ended.

    Raises DoraSystemdError as Selector.find_enabled().
    """
    given = selectors_of(texts, read_cells(manager))
    found = {one.uuid: one for one in (find_start(manager, scope, text) for text in given)}
    cells = [one for one in found.values() if isinstance(one, Cell)]
    return cells, [one for one in found.values() if isinstance(one, Asked)]


def find_start(
    manager: Manager, scope: Scope, selector: Selector, is_changed: bool = False
) -> Cell | Asked:
    """The dataflow that is meant: what systemd knows, else the last start in the journal.

    is_changed: the last start in any case, for other settings. Raises DoraSystemdError as
    Selector.find_enabled() if there is neither, or this user may not read the journal; NOT_FOUND
    if it ran from a release after that start, for a start of the project is not what was deployed.
    """
    try:
        cell = selector.find_enabled(manager, scope)
    except DoraSystemdError as error:
        if error.code is ExitCode.NOT_FOUND and (found := _readable(scope, selector)):
            _refuse_released(scope, found)
            return found
        raise _without_start(scope, selector) or _with_file(selector, error) from error
    if not is_changed:
        return cell
    if found := find_asked(scope, Selector(cell.name)):
        return found
    message = f"cannot change settings of {cell.name}: the journal does not have its start"
    file = shell_word(cell.options.dataflow)
    raise DoraSystemdError(message, f"doractl start {file} takes the file itself")


def _without_start(scope: Scope, selector: Selector) -> DoraSystemdError | None:
    """The error for a dataflow that has ended and has no recorded start, as after a first trial."""
    with suppress(DoraSystemdError):
        if row := selector.ended(scope):
            if release := _committed(scope, row.name):
                return _disabled(row.name, release)
            message = f"cannot start {row.name}: the journal does not have its start"
            hint = f"doractl start FILE --name {row.name}, or doractl deploy --name {row.name}"
            return DoraSystemdError(message, hint, ExitCode.NOT_FOUND)
    return None


def _with_file(selector: Selector, error: DoraSystemdError) -> DoraSystemdError:
    """Return the error; for a directory of that name, with its dataflow file as the hint."""
    file = Path(selector.text) / DEFAULT_FILE
    with suppress(OSError):  # the current directory was removed
        if exists(file.absolute()):
            return DoraSystemdError(error.message, f"did you mean {file}?", error.code)
    return error


def _readable(scope: Scope, selector: Selector) -> Asked | None:
    """Find the record as find_asked() does; None also if the journal cannot be read."""
    with suppress(DoraSystemdError):
        return find_asked(scope, selector)
    return None


def _refuse_released(scope: Scope, asked: Asked) -> None:
    if release := _committed(scope, asked.name):
        raise _disabled(asked.name, release, f", or doractl start {shell_word(asked.dataflow)}")


def _disabled(name: str, release: str, otherwise: str = "") -> DoraSystemdError:
    message = f"cannot start {name}: its release {release} is disabled"
    hint = f"doractl rollback {name} {release}{otherwise}"
    return DoraSystemdError(message, hint, ExitCode.NOT_FOUND)


def _committed(scope: Scope, name: str) -> str:
    """The release that has passed its trial since the last start of a project, or ""."""
    from dora_systemd.adapters.journal.reader import JournalReader
    from dora_systemd.decisions.logs.query import request_matches

    matches = [*request_matches(scope, EVENT, COMMITTED), f"DORA_DATAFLOW_NAME={name}"]
    newest = next(JournalReader().newest(matches, 1), {})
    return str(newest.get("DORA_RELEASE", "")) if newest.get("DORA_EVENT") == COMMITTED else ""


def _asked(scope: Scope, matches: list[str]) -> Iterator[Asked]:
    # Imported late: only a start by name, of what has ended, reads the journal.
    from dora_systemd.adapters.journal.reader import JournalReader
    from dora_systemd.decisions.logs.query import request_matches

    every, forgotten = [*request_matches(scope, EVENT, FORGOTTEN), *matches], set[object]()
    for record in JournalReader().newest(every, None, is_whole=True):
        if record.get("DORA_EVENT") == FORGOTTEN:
            forgotten.add(record.get("DORA_DATAFLOW_NAME"))
        if record.get("DORA_DATAFLOW_NAME") in forgotten:
            continue
        with suppress(ValueError, TypeError, AttributeError, RecursionError):
            if record.get("_PID") != _INIT and (found := _parse(record)):
                yield found


def _parse(record: Mapping[str, Any]) -> Asked | None:
    keys = ("DORA_DATAFLOW_NAME", "DORA_DATAFLOW", "DORA_FILE", "DORA_SETTINGS")
    name, uuid, path, settings = (str(record.get(key, "")) for key in keys)
    flags = json.loads(settings)
    if not (is_name(name) and is_uuid(uuid) and Path(path).is_absolute()):
        return None
    return Asked(name, uuid, path, {key: _flag(value) for key, value in flags.items()})


def _flag(value: object) -> object:
    return tuple(map(str, value)) if isinstance(value, list) else str(value)
