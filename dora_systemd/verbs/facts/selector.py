"""Selectors: finds the dataflow that a name, a unit, a UUID or its beginning selects.

Every search for a dataflow that a user or a client names begins here, so that all verbs accept the
same selectors and report the same errors. `list` without a name does not load this module.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup.groups import group_path, has_group
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import (
    MIN_PREFIX,
    SLICE,
    UNIT_PREFIX,
    UNIT_SUFFIX,
    Named,
    did_you_mean,
    is_name,
    is_uuid_prefix,
    name_from_unit,
    unit_name,
)
from dora_systemd.scope import Scope
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.cells import Cell, read_cell, read_cells
from dora_systemd.verbs.facts.enabled import lost_units

if TYPE_CHECKING:
    from dora_systemd.decisions.views.rows import DataflowRow

_SHOWN = 10
_PATTERN = r"[*?\[]"
_NOTHING = "nothing is running; ended ones: doractl list --all"
_TOO_SHORT = f"the beginning of a UUID must have at least {MIN_PREFIX} characters"
OF_SYSTEM = "a dataflow of that name runs in system scope: add --system, or use sudo"


N = TypeVar("N", bound=Named)


def runs_for_root(names: Iterable[str]) -> bool:
    """Whether one of these runs in system scope, and the calling user is not root.

    Reads no more than a directory of the cgroup tree, which every user may read.
    """
    units = [unit_name(one) for one in names if is_name(one)] if os.geteuid() else []
    with suppress(DoraSystemdError):
        return any(has_group(group_path(f"/{SLICE}/{one}")) for one in units)
    return False


class Selector(NamedTuple):
    """The text that a user has typed: a name, a unit, a UUID, or the beginning of a UUID.

    Only meant() decides what a text means. only(), proven(), loaded(), find(), find_present(),
    find_enabled(), find_name() and ended() differ in where they look. They raise DoraSystemdError:
    USAGE if several dataflows match, and those that return no None, NOT_FOUND if none does.
    """

    text: str

    @property
    def name(self) -> str:
        """The text, or the name in the name of a unit of ours; the name is not checked."""
        return name_from_unit(self.text) or self.text

    def meant(self, known: Iterable[N]) -> list[N]:
        """Return those of `known` that match, in their order; a name precedes UUIDs."""
        candidates = list(known)
        for name in self.names:
            if named := [one for one in candidates if one.name == name]:
                return named
        if not is_uuid_prefix(self.text):
            return []
        return [one for one in candidates if one.uuid.startswith(self.text.lower())]

    @property
    def names(self) -> list[str]:
        """The names that the text can mean.

        As in systemctl, ".service" may be left out; a dataflow can be called dora-x, too.
        """
        short = name_from_unit(f"{self.text}{UNIT_SUFFIX}")
        return [self.name, *([short] if short else [])]

    def only(self, known: Iterable[N]) -> N | None:
        """The only one of `known` that matches, None if none does."""
        found = self.meant(known)
        if len(found) > 1:
            candidates = ", ".join(f"{one.uuid} ({one.name})" for one in found[:_SHOWN])
            raise usage_error(f"{quoted(self.text)} is ambiguous", f"one of {candidates}")
        return found[0] if found else None

    def missing(
        self, names: Iterable[str], is_of_system: Callable[[Iterable[str]], bool] = runs_for_root
    ) -> DoraSystemdError:
        """The error (NOT_FOUND) if nothing matches. names: of the dataflows that are known.

        is_of_system: whether a dataflow with one of these names runs in system scope.
        """
        # A unit of that very name is not ours, and no hint.
        known = sorted({*names}.difference(self.names))
        is_there = is_of_system(self.names)
        hint = OF_SYSTEM if is_there else did_you_mean(self.text, known)
        if not hint:
            there = f"known dataflows: {', '.join(known[:_SHOWN])}" if known else _NOTHING
            # Also the text of a name such as "bad".
            is_short = len(self.text) < MIN_PREFIX and is_uuid_prefix(self.text, 1)
            hint = f"{there}; {_TOO_SHORT}" if is_short else there
        return DoraSystemdError(f"no dataflow named {quoted(self.text)}", hint, ExitCode.NOT_FOUND)

    def proven(self, cells: Iterable[Cell]) -> Cell | None:
        """Find the cell as only() does; None for a unit that only has a Description= like ours."""
        cell = self.only(cells)
        return cell if cell and cell.has_options else None

    def loaded(self, cells: Iterable[Cell]) -> Cell:
        """Find the cell among `cells`, from read_cells(), with its options."""
        known = list(cells)
        cell = self.proven(known)
        if cell is None:
            raise self.missing(one.name for one in known)
        return cell

    def find(self, manager: Manager) -> Cell:
        """Find a dataflow that systemd has loaded, or can load from a unit file."""
        cells = read_cells(manager)
        names = () if self.only(cells) else filter(is_name, self.names)
        files = filter(None, (read_cell(manager, unit_name(one)) for one in names))
        return next(files, None) or self.loaded(cells)

    @contextmanager
    def telling_ended(self, scope: Scope) -> Iterator[None]:
        """Turn NOT_FOUND into NOT_RUNNING for an ended dataflow, which only the journal knows."""
        try:
            yield
        except DoraSystemdError as error:
            row = self._recorded(scope) if error.code is ExitCode.NOT_FOUND else None
            if row is None:
                raise
            message = f"cannot use the dataflow {row.name}: it has ended"
            hint = f"doractl start {row.name}"
            raise DoraSystemdError(message, hint, ExitCode.NOT_RUNNING) from error

    def find_present(self, manager: Manager, scope: Scope) -> Cell:
        """Find a dataflow as find() does, with the error of telling_ended() for an ended one."""
        with self.telling_ended(scope):
            return self.find(manager)

    def find_enabled(self, manager: Manager, scope: Scope) -> Cell:
        """Find a dataflow as find() does, also an enabled one that lost_units() returns."""
        try:
            return self.find(manager)
        except DoraSystemdError as error:
            if error.code is not ExitCode.NOT_FOUND or not lost_units(manager, scope):
                raise
        manager.reload()
        return self.find(manager)

    def ended(self, scope: Scope) -> "DataflowRow | None":
        """Find the newest matching dataflow with an end in the journal, or None."""
        # Imported late: the journal is slow, and dataflows that systemd knows do not need it.
        from dora_systemd.verbs.facts.ended import ended_of_name, ended_rows

        named = (ended_of_name(scope, one) for one in self.names if is_name(one))
        found = next(filter(None, named), None)
        return found or next(iter(self.meant(ended_rows(scope))), None)

    def find_name(self, manager: Manager, scope: Scope, kept: Sequence[str]) -> str:
        """Find the name of a dataflow in `kept`, or of one that systemd knows or that has ended.

        kept: the names of dataflows of which files are kept.
        """
        if name := next((one for one in self.names if one in kept), ""):
            return name
        try:
            return self.find(manager).name
        except DoraSystemdError as error:
            if error.code is ExitCode.NOT_FOUND and (ended := self.ended(scope)):
                return ended.name
            raise

    def _recorded(self, scope: Scope) -> "DataflowRow | None":
        """Find an ended dataflow as ended() does; None also if the journal cannot be read."""
        with suppress(DoraSystemdError):
            return self.ended(scope)
        return None


def selectors_of(texts: Sequence[str], known: Iterable[Named]) -> list[Selector]:
    """A selector for each text; a pattern as in glob(7) gives one for each match in `known`.

    Raises DoraSystemdError (NOT_FOUND) for a pattern that matches none.
    """
    candidates = list(known)
    return [one for text in texts for one in _expanded(text, candidates)]


def is_pattern(text: str) -> bool:
    """Whether it is a pattern as in glob(7)."""
    return re.search(_PATTERN, text) is not None


def find_all(manager: Manager, scope: Scope, texts: Sequence[str]) -> list[Cell]:
    """The dataflows that `texts` mean, each once; as selectors_of() and find_enabled().

    Raises DoraSystemdError (NOT_RUNNING) for one that has ended.
    """
    cells, found = read_cells(manager), dict[Cell, None]()
    for one in selectors_of(texts, cells):
        with one.telling_ended(scope):
            found[one.proven(cells) or one.find_enabled(manager, scope)] = None
    return list(found)


def _expanded(text: str, known: Sequence[Named]) -> list[Selector]:
    if not is_pattern(text):
        return [Selector(text)]
    # "*o*" must not match every dataflow because of the "dora-" of its unit.
    units = text.startswith(UNIT_PREFIX)
    fitting = [
        one.name
        for one in known
        if fnmatchcase(one.name, text) or (units and fnmatchcase(unit_name(one.name), text))
    ]
    if not fitting:
        raise Selector(text).missing(one.name for one in known)
    return [Selector(name) for name in fitting]
