"""Which records of the journal a user means: of which dataflows, nodes and runs."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import islice
from typing import NamedTuple

from dora_systemd.adapters.journal.reader import JournalReader, read_when_written
from dora_systemd.decisions.logs.query import LogQuery
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope
from dora_systemd.values import quoted
from dora_systemd.verbs.facts.ended import not_recorded
from dora_systemd.verbs.facts.selector import Selector, is_pattern, selectors_of

_MOST_FITTING = 100
"""Maximum UUIDs with the same beginning: any user can write records with more."""


def find_soon(find: Callable[[], LogQuery], scope: Scope, selectors: Sequence[str]) -> LogQuery:
    """Call `find` again for a moment: a running dataflow may not be recorded yet."""

    def read() -> LogQuery | DoraSystemdError:
        try:
            return find()
        except DoraSystemdError as error:
            if error.code is not ExitCode.NOT_FOUND:
                raise
            return error

    def is_behind(found: LogQuery | DoraSystemdError) -> bool:
        is_error = isinstance(found, DoraSystemdError)
        return is_error and bool(selectors) and _is_loaded(scope, selectors)

    found = read_when_written(read, is_behind)
    if isinstance(found, DoraSystemdError):
        raise found
    return found


def _is_loaded(scope: Scope, selectors: Sequence[str]) -> bool:
    """Whether systemd has a dataflow that is meant; not if it is out of reach."""
    # Imported late: the journal is read without systemd.
    from dora_systemd.adapters.bus.systemd import Bus
    from dora_systemd.verbs.facts.cells import read_cells

    with suppress(DoraSystemdError):
        cells = read_cells(Bus(scope, for_reading=True))
        return any(one.meant(cells) for one in map(Selector, selectors))
    return False


class _Recorded(NamedTuple):
    name: str
    uuid: str = ""


_WORDS = {"CURRENT": 0, "PREVIOUS": 1}
"""Of --run, in capitals or not; dora's ids of runs have digits."""
_OFFSET = "-?0|-[1-9][0-9]{0,3}"


def find_query(
    journal: JournalReader,
    query: LogQuery,
    selectors: Sequence[str],
    nodes: Sequence[str] = (),
    run: str = "ALL",
) -> LogQuery:
    """The query, with the names, nodes and runs that the journal has for it.

    selectors: names, units, UUIDs or patterns; none for all dataflows of the scope. nodes: names or
    patterns as in glob(7). run: CURRENT or 0, PREVIOUS or -1, -2 and so on, ALL, or dora's id of a
    run. Raises DoraSystemdError: NOT_FOUND for a dataflow, node or run without any record.
    """
    found = [query]
    if selectors:
        known = _dataflows(journal, query.scope, selectors)
        found = [replace(query, **one._asdict()) for one in known]
    if nodes or query.levels:
        found = _with_nodes(journal, found, nodes)
    first, *others = (_select_run(journal, one, run) for one in found)
    return replace(first, others=tuple(others))


def _dataflows(journal: JournalReader, scope: Scope, texts: Sequence[str]) -> list[_Recorded]:
    names = [_Recorded(name) for name in journal.known_names(scope)]
    try:
        found = [_dataflow(journal, scope, one, names) for one in selectors_of(texts, names)]
    except DoraSystemdError as error:
        raise not_recorded(error) from error
    return list(dict.fromkeys(found))


def _dataflow(
    journal: JournalReader, scope: Scope, wanted: Selector, names: list[_Recorded]
) -> _Recorded:
    if named := wanted.only(names):
        return named
    fitting = wanted.meant(_Recorded("", uuid) for uuid in journal.known_uuids())
    named_ones = ((journal.name_of(scope, one.uuid), one.uuid) for one in fitting[:_MOST_FITTING])
    found = wanted.only(_Recorded(name, uuid) for name, uuid in named_ones if name)
    if found is None:
        raise wanted.missing(one.name for one in names)
    return found


def _with_nodes(
    journal: JournalReader, queries: list[LogQuery], patterns: Sequence[str]
) -> list[LogQuery]:
    """Add the nodes to the queries; leave out queries of dataflows without any of the nodes."""
    if not queries[0].name:
        hint = "say which dataflow: doractl logs NAME --node NODE"
        raise usage_error("cannot select nodes of all dataflows", hint)
    known = [journal.known_nodes(one.scope, one.name, patterns) for one in queries]
    if not patterns:
        every = zip(queries, known, strict=True)
        return [replace(one, nodes=("", *nodes)) for one, nodes in every]
    for pattern in patterns:
        if not any(_fitting(nodes, pattern) for nodes in known):
            nodes = dict.fromkeys(node for each in known for node in each)
            raise _no_node(pattern, [one.name for one in queries], list(nodes))
    found = []
    for one, there in zip(queries, known, strict=True):
        nodes = dict.fromkeys(node for pattern in patterns for node in _fitting(there, pattern))
        found += [replace(one, nodes=tuple(nodes))] if nodes else []
    return found


def _fitting(nodes: Sequence[str], pattern: str) -> list[str]:
    if not is_pattern(pattern):
        return [pattern] if pattern in nodes else []
    return [node for node in nodes if node == pattern or fnmatchcase(node, pattern)]


def _no_node(pattern: str, names: Sequence[str], known: Sequence[str]) -> DoraSystemdError:
    message = f"cannot find a node {quoted(pattern)} of dataflow {', '.join(names)}"
    hint = f"nodes: {', '.join(known)}" if known else "no node has written anything yet"
    return DoraSystemdError(message, hint, ExitCode.NOT_FOUND)


def _runs_before(run: str) -> int | None:
    """Parse an offset of runs before the last, as in `journalctl --boot`; None for an id."""
    return -int(run) if re.fullmatch(_OFFSET, run) else _WORDS.get(run.upper())


def _select_run(journal: JournalReader, query: LogQuery, run: str) -> LogQuery:
    if run.upper() == "ALL":
        return query
    index = _runs_before(run)
    if index is None:
        if run and not journal.has_run(query.scope, query.name, run):
            hint = f"doractl logs {query.name or 'NAME'} --events shows when each run began; "
            hint += "valid values: CURRENT, PREVIOUS, -2 ..., ALL, an id (DORA_RUN)"
            raise DoraSystemdError(f"cannot find the run {quoted(run)}", hint, ExitCode.NOT_FOUND)
        return replace(query, run=run)
    if not query.name:
        hint = "say which dataflow: doractl logs NAME --run CURRENT"
        raise usage_error("cannot select a run of all dataflows", hint)
    lives = journal.invocations(query.scope, query.name, query.uuid)
    invocation = next(islice(lives, index, None), None)
    if invocation is None:
        which = f"{run.lower()} run" if run.upper() in _WORDS else f"run {run}"
        message = f"cannot find the {which} of dataflow {query.name}"
        raise DoraSystemdError(message, "--run ALL shows all there is", ExitCode.NOT_FOUND)
    return replace(query, invocation=invocation)
