"""`doractl deploy --from-stdin`: deploys a project that `deploy -H` of another host sends.

Who sends it has logged in as the user of this process, so the files belong to that user.
"""

import errno
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.releases.draft import Draft
from dora_systemd.adapters.releases.store import Store, unusable
from dora_systemd.adapters.releases.transfer import Stream, incoming
from dora_systemd.decisions.releases.manifest import Stored, of_project, touched
from dora_systemd.decisions.releases.parcel import (
    MOST_HEAD,
    Parcel,
    format_wants,
    missing,
    parse_parcel,
    total,
)
from dora_systemd.decisions.releases.progress import copying, waiting
from dora_systemd.decisions.settings.table import USER, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import unit_name
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.locks import IfInhibited, require_uninhibited
from dora_systemd.verbs.releases.copy import newest
from dora_systemd.verbs.releases.deploy import Deployed, DeployRequest, deploy, present
from dora_systemd.verbs.releases.listing import root_of, store_of
from dora_systemd.verbs.releases.soak import Tell
from dora_systemd.verbs.releases.source import Source, find_source
from dora_systemd.verbs.releases.trial import read_deployable
from dora_systemd.verbs.start.read import read_files
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.settings import settings_of
from dora_systemd.verbs.start.where import choose_user

Warn = Callable[[str], None]


class Known(NamedTuple):
    """The files that are here already, unchanged."""

    tree: Path  # where they are
    files: Mapping[str, Stored]


def _known(store: Store) -> Known:
    last = newest(store)
    return Known(store.tree(last.id), store.intact(last)) if last else Known(store.path, {})


def compare_sent(
    manager: Manager, scope: Scope, stream: Stream
) -> tuple[str, dict[str, list[str]]]:
    """Find what a deploy of a sent project would change, as compare(). Raises DoraSystemdError."""
    parcel = parse_parcel(stream.line(MOST_HEAD))
    last = present(manager, scope, store_of(scope, parcel.name))
    return last.id if last else "", touched(of_project(last.files) if last else {}, parcel.files)


def receive(
    manager: Manager,
    scope: Scope,
    request: DeployRequest,
    stream: Stream,
    answer: Callable[[str], None],
    tell: Tell,
    warn: Warn,
) -> Deployed:
    """Deploy the project that arrives by `stream`; at the end of `stream` undo the trial.

    answer: gets the line that lists the contents to send. `tell`, warn: as of deploy(). Raises
    DoraSystemdError, as deploy().
    """
    parcel = parse_parcel(stream.line(MOST_HEAD))
    store = store_of(scope, parcel.name)
    standing = read_deployable(manager, scope, unit_name(parcel.name))
    if request.how is IfInhibited.REFUSE:  # a wait must see the end of `stream`: deploy() waits
        require_uninhibited(
            scope, standing.running, "deploy", request.how, lambda text: tell(waiting(text))
        )
    root = root_of(scope)
    try:
        with _ends_quietly(parcel.name), incoming(root) as draft:
            known = _known(store)
            wants = missing(parcel, known.files)
            _require_space(draft, parcel, wants)
            answer(format_wants(wants))
            _fill(stream, parcel, wants, draft, known, tell)
            with _ends_with(stream), _named(draft, parcel):
                source, start = _source(scope, request, parcel, draft)
                _require_user(scope, parcel, source)
                sent = replace(request, start=start)
                told = _renamed(warn, str(draft.tree), parcel.source)
                return deploy(manager, scope, sent, tell, told, source)
    except OSError as error:
        raise unusable(root, error) from error


@contextmanager
def _ends_quietly(name: str) -> Iterator[None]:
    """Let SIGTERM and SIGHUP leave nothing here."""
    signals = (signal.SIGTERM, signal.SIGHUP)
    before = {one: signal.signal(one, _interrupt) for one in signals}
    try:
        yield
    except KeyboardInterrupt as error:
        hint = f"doractl releases {name} shows which release runs"
        message = "the deploy was interrupted"
        raise DoraSystemdError(message, hint, ExitCode.INTERRUPTED) from error
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _interrupt(*_arguments: object) -> None:
    raise KeyboardInterrupt


@contextmanager
def _ends_with(stream: Stream) -> Iterator[None]:
    """In the context, end this process as SIGTERM does when the other host hangs up."""
    is_over, end = os.pipe()

    def watch() -> None:
        if stream.wait_for_end(is_over):
            os.kill(os.getpid(), signal.SIGTERM)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        os.write(end, b".")
        watcher.join()
        os.close(end)
        os.close(is_over)


def _require_space(draft: Draft, parcel: Parcel, wants: list[int]) -> None:
    contents = parcel.contents
    if total([contents[one] for one in wants]) > draft.free_bytes():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _fill(
    stream: Stream, parcel: Parcel, wants: list[int], draft: Draft, known: Known, tell: Tell
) -> None:
    """Write all files: those that come, and those that the last release has, too."""
    places = {one.digest: known.tree / path for path, one in known.files.items()}
    paths = {one.digest: path for path, one in reversed([*parcel.files.items()])}
    contents = [parcel.contents[number] for number in wants]
    done, whole = 0, total(contents)
    for one in contents:
        tell(copying(done, whole))
        path = paths[one.digest]
        wanted = parcel.files[path]
        _require_same(
            path, wanted, draft.write(path, stream.chunks(one.size), wanted.is_executable)
        )
        places[one.digest] = draft.tree / path
        done += one.size
    sent = {paths[one.digest] for one in contents}
    for path, one in parcel.files.items():
        if one.target:
            draft.link(path, one.target)
        elif known.files.get(path) == one:
            draft.adopt(path, known.tree / path)
        elif path not in sent:
            copied = draft.copy(path, places[one.digest], one.is_executable)
            _require_same(path, one, copied)


def _require_same(path: str, announced: Stored, stored: Stored) -> None:
    if announced != stored:
        raise bad_input(f"cannot receive {path}: it is not what was announced", "deploy again")


def _source(
    scope: Scope, request: DeployRequest, parcel: Parcel, draft: Draft
) -> tuple[Source, StartRequest]:
    """The project where it waits, which the user of its nodes can read now."""
    path, flags = draft.tree / parcel.dataflow, dict(request.start.flags)
    directory = path.parent
    if parcel.directory is not None:
        directory = draft.tree / parcel.directory
        flags[WORKING_DIRECTORY.name] = str(directory)
    start = request.start._replace(dataflow=str(path), name=parcel.name, flags=flags)
    files = read_files(start)
    settings = settings_of(scope, files, start)
    user = choose_user(scope, settings[USER], files.place, str(directory), settings.source(USER))
    draft.lend(None if user is None else user.pw_gid)
    source = find_source(scope, start, bool(request.build_timeout))
    # All files that were sent, whatever the rules about files on this host are.
    named = tuple(parcel.files)
    sent = parcel.source or "standard input"
    return replace(source, named=named, sent=sent, revision=parcel.revision), start


def _require_user(scope: Scope, parcel: Parcel, source: Source) -> None:
    """Raise DoraSystemdError (NO_PERMISSION) for another user's project that root sends.

    On this host that user's code would run as the user of all of root's dataflows.
    """
    user = source.plan.user
    if scope.is_user or user is None or not parcel.owner or source.plan.settings.is_given(USER):
        return
    message = f"cannot deploy {parcel.name}: {parcel.owner} owns it where it comes from"
    reason = f"and here it would run as {user.pw_name}, like root's dataflows"
    hint = f"name the user here that it is to run as: --uid USER, such as --uid {user.pw_name}"
    raise DoraSystemdError(f"{message}, {reason}", hint, ExitCode.NO_PERMISSION)


@contextmanager
def _named(draft: Draft, parcel: Parcel) -> Iterator[None]:
    """Let errors name the project as it is called where it comes from."""
    try:
        yield
    except DoraSystemdError as error:
        texts = (error.message, error.hint)
        message, hint = (text.replace(str(draft.tree), parcel.source) for text in texts)
        raise DoraSystemdError(message, hint, error.code) from error


def _renamed(warn: Warn, place: str, name: str) -> Warn:
    return lambda text: warn(text.replace(place, name))
