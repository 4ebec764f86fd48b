"""Packs a project for `deploy -H`. The hosts decide whatever depends on a machine."""

import contextlib
import hashlib
import os
import posixpath
import pwd
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.adapters.releases.transfer import Spool, spooled
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.decisions.releases.manifest import Found, Stored, refusal
from dora_systemd.decisions.releases.parcel import Parcel
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings
from dora_systemd.decisions.settings.table import ENV_FILE, VENV, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.names import settings_path
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import Place, exists, other_user, reached
from dora_systemd.trust.programs import Account
from dora_systemd.trust.project import opened_project
from dora_systemd.values import format_rounded_size, shown
from dora_systemd.verbs.releases.files import copy_files, find_files
from dora_systemd.verbs.releases.source import named_paths, project_file, project_root
from dora_systemd.verbs.start.read import SettingsFile, read_beside
from dora_systemd.verbs.start.request import StartRequest, request_name
from dora_systemd.verbs.start.settings import require_modest
from dora_systemd.verbs.start.where import DEFAULT_USER, account_of, choose_user

_NO_PLACE = "/dev/null"
"""No file can be below it."""
_MOST_LINKS = 40


class Packed(NamedTuple):
    """A parcel and the contents of its files."""

    parcel: Parcel
    spool: Spool


class Sender(NamedTuple):
    """A project to send."""

    place: Place
    dataflow: Dataflow
    settings: Settings
    root: str
    directory: str  # its working directory, "" for that of the dataflow file
    # the content of the settings file next to the dataflow file, None without one
    beside: bytes | None


@contextlib.contextmanager
def packed(
    request: StartRequest,
    tell: Callable[[str], None],
    warn: Callable[[str], None],
    find_reader: Callable[[Sender], Account | None] | None = None,
) -> Iterator[Packed]:
    """Pack a copy of the project that `request` names.

    `tell`: gets each stage; warn: each warning. find_reader: returns the account that reads the
    project. Raises DoraSystemdError.
    """
    sender = _find(request)
    if note := _venv_note(sender):
        warn(note)
    root, dataflow = sender.root, sender.dataflow
    directory = sender.directory or root
    environment_files = sender.settings[ENV_FILE]
    named = named_paths(dataflow, directory, root, environment_files)

    def progress(done: int, total: int) -> None:
        tell(f"packing: {format_rounded_size(done)} of {format_rounded_size(total)}")

    with spooled() as spool:
        reader = (find_reader or _reader)(sender)
        with opened_project(root, reader) as project:
            found, revision = find_files(project, named, _owners(reader))
            if reader is None and os.geteuid() == 0:
                _require_roots(root, found)
            _require_own(found, root, dataflow)
            files = copy_files(project, found, spool, None, progress)
            _require_same(sender, files)
        parcel = Parcel(
            name=request_name(StartRequest(dataflow.source, request.name)),
            source=shown(root),
            dataflow=os.path.relpath(dataflow.source, root),
            directory=os.path.relpath(directory, root) if sender.directory else None,
            revision=revision,
            files=files,
            owner=_foreign_owner(sender),
        )
        yield Packed(parcel, spool)


def _find(request: StartRequest) -> Sender:
    path = project_file(request)
    written, read = read_file(path), read_beside(path)
    if read:
        _require_trusted(read)
    documents = [(str(read.path), read.document)] if read else []
    settings = resolve_settings(request.flags, {}, documents)
    given = settings[WORKING_DIRECTORY]
    directory = "" if given is None else os.path.normpath(Path(given).absolute())
    root = project_root(path, directory or str(path.parent))
    said = read.data if read else None
    dataflow = parse_dataflow(parse_yaml(decoded(written.data, path), path), str(path))
    return Sender(written.place, dataflow, settings, root, directory, said)


def _require_trusted(read: SettingsFile) -> None:
    """Refuse settings by which another user would get the rights of the login on the host."""
    caller = os.geteuid()
    if read.is_roots or (caller and not read.place.borrowed and read.place.uid == caller):
        return
    require_modest(read)
    # On this machine the owner of the file reads these files, on the host the user who logs in.
    for file in resolve_settings({}, {}, [(f"{_NO_PLACE}/x.yml", read.document)])[ENV_FILE]:
        if not os.path.normpath(file).startswith(f"{_NO_PLACE}/"):
            message = f"cannot send {shown(str(read.path))}: env_file is not in the project"
            hint = "name it relative to that file, or give it with --env-file"
            raise DoraSystemdError(message, hint, ExitCode.NO_PERMISSION)


def _require_same(sender: Sender, files: Mapping[str, Stored]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) unless the settings that were checked are in the parcel.

    The account that reads the project for root can change them meanwhile, or lie about them.
    """
    path = os.path.relpath(settings_path(sender.dataflow.source), sender.root)
    packed_one = _behind_links(path, files)
    wanted = None if sender.beside is None else hashlib.sha256(sender.beside).hexdigest()
    if (packed_one and packed_one.digest) != wanted:
        raise refusal(path, "it changed while it was packed", "deploy again")


def _behind_links(path: str, files: Mapping[str, Stored]) -> Stored | None:
    """The file that a path leads to, None if it is not in the parcel."""
    one = files.get(path)
    for _ in range(_MOST_LINKS):
        if one is None or not one.target:
            break
        path = posixpath.normpath(posixpath.join(posixpath.dirname(path), one.target))
        one = files.get(path)
    return one


def _venv_note(sender: Sender) -> str:
    """The warning for a virtual environment that a deploy here would use, or ""."""
    venv = str(Path(sender.dataflow.source).parent / ".venv")
    if sender.settings.is_given(VENV) or not exists(f"{venv}/bin/python"):
        return ""
    return f"{shown(venv)} stays here: name a virtual environment of the hosts with --venv"


def _reader(sender: Sender) -> Account | None:
    """Return who reads the project, None for the caller: never root what others can change."""
    try:
        pwd.getpwnam(DEFAULT_USER)
    except KeyError:
        if sender.place.uid == 0:
            return None
    if os.geteuid() != 0:
        return None
    return account_of(choose_user(Scope(is_user=False, uid=0), None, sender.place, sender.root))


def _foreign_owner(sender: Sender) -> str:
    """Return the owner of the dataflow file, "" for root and the caller, whom the host trusts."""
    return other_user(sender.place.uid)


def _owners(reader: Account | None) -> list[int]:
    """Whose repositories git may read: it runs programs that they name.

    None where root reads: others may be able to write to a repository of root's.
    """
    if reader is not None:
        return [0, reader.uid]
    return [0, os.geteuid()] if os.geteuid() else []


def _require_roots(root: str, found: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) unless only root can replace files of the project."""
    for directory in sorted({Path(path).parent for path in found}):
        with reached(Path(root, directory)) as (_, place):
            if not place.is_roots:
                message = f"cannot read {shown(place.path)} as root: others can change it"
                hint = f"let its owner deploy it, or make the user {DEFAULT_USER}, who reads it"
                raise bad_input(message, hint)


def _require_own(found: Mapping[str, Found], root: str, dataflow: Dataflow) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for what is not in the parcel and only works here."""
    if os.path.relpath(dataflow.source, root) not in found:
        message = f"cannot send {shown(dataflow.source)}: it is not in the project"
        raise bad_input(message, "deploy a file, no link to it")
    for node in dataflow.nodes:
        if node.path.startswith(f"{root.rstrip('/')}/"):
            message = f"cannot send node {node.id}: its path {shown(node.path)} is of this machine"
            raise bad_input(message, f"write it relative to {shown(root)}")
