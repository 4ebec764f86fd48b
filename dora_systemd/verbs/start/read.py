"""Reads the files of a start, each once, with who could have written it.

Also finds the paths that the nodes of a descriptor name, before dora has expanded it. That does not
run dora, which would have to run as the user and only reads the same files. It leaves out
unreadable files: the runner reports them at the start.
"""

import errno
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import Dataflow, parse_dataflow
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import release_of, settings_path
from dora_systemd.scope import Scope, config_home
from dora_systemd.trust.files import Text, read_file, unreadable
from dora_systemd.trust.paths import Place, exists, is_link, refusal
from dora_systemd.trust.sight import Sight
from dora_systemd.values import as_mapping
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest, path_of, request_name

SYSTEM_FILE = Path("/etc/dora-systemd/config.yml")
USER_FILE = Path("dora-systemd/config.yml")


class SettingsFile(NamedTuple):
    """A settings file that was read: its content, and its place."""

    path: Path
    place: Place
    data: bytes
    document: object

    @property
    def is_roots(self) -> bool:
        """Whether only root can have written and placed the file."""
        return not self.place.changeable


class Files(NamedTuple):
    """The dataflow file and its settings files, as they were read."""

    name: str  # of the dataflow
    path: Path  # absolute, of the dataflow file
    text: Text
    place: Place  # of the file whose owner decides: the dataflow file, or the origin of a release
    beside: SettingsFile | None  # that of this dataflow
    general: tuple[SettingsFile, ...]  # those for all dataflows, highest precedence first

    def dataflow(self) -> Dataflow:
        """The dataflow, with modules as they are. Raises DoraSystemdError (BAD_INPUT)."""
        document = parse_yaml(decoded(self.text.data, self.path), self.path)
        return parse_dataflow(document, str(self.path))


def read_files(request: StartRequest) -> Files:
    """Read what a request names. Raises DoraSystemdError."""
    path, origin, name = path_of(request), request.origin, request_name(request)
    text = _read(path, request)
    if origin is None:
        _refuse_release(path)
    beside = read_beside(path, origin)
    return Files(name, path, text, origin or text.place, beside, read_general(request.environment))


def _read(path: Path, request: StartRequest) -> Text:
    """The dataflow file, at `path`. Raises DoraSystemdError (BAD_INPUT)."""
    try:
        return read_file(path)
    except DoraSystemdError as error:
        if exists(path) or not (request.uuid or request.dataflow == DEFAULT_FILE):
            raise
        # The user has named a dataflow that ran from this file, or nothing.
        hint = "go to the directory of a dataflow, or name its file"
        if request.uuid:
            hint = "put the file back, or start another one"
        raise DoraSystemdError(error.message, hint, error.code) from error


def _refuse_release(path: Path) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a file of a release.

    Such a file is owned by root, but not written by root, who must not trust its settings.
    """
    if release := release_of(str(path)):
        message = f"cannot start {path}: it belongs to a release"
        raise bad_input(message, f"doractl rollback NAME {release} runs that release")


def read_beside(dataflow: Path, origin: Place | None = None) -> SettingsFile | None:
    """The settings file of a dataflow, if there is one. Raises DoraSystemdError (BAD_INPUT).

    origin: of a release, the place of the original dataflow file, which counts for the settings
    file that was copied with it.
    """
    path = Path(settings_path(str(dataflow)))
    return read_settings_file(path, origin) if has_settings(path) else None


def read_general(environment: Mapping[str, str]) -> tuple[SettingsFile, ...]:
    """The settings files for all dataflows, highest precedence first. Raises DoraSystemdError."""
    return tuple(read_settings_file(one) for one in config_files(environment) if has_settings(one))


def has_settings(path: Path) -> bool:
    """Whether a settings file is at `path`.

    Raises DoraSystemdError (BAD_INPUT) for a link that leads nowhere: without the file the limits
    in it would be lost, and nobody would notice.
    """
    if exists(path):
        return True
    if is_link(path):
        reason = "it is a link that leads to no readable file"
        raise refusal(path, reason, "correct the link, or remove it")
    return False


def config_files(environment: Mapping[str, str]) -> list[Path]:
    """The settings files for all dataflows that may exist, highest precedence first."""
    config = config_home(environment)
    return [*([Path(config) / USER_FILE] if config else []), SYSTEM_FILE]


def config_file(scope: Scope, environment: Mapping[str, str]) -> Path:
    """The settings file for all dataflows of the scope; it need not exist."""
    return config_files(environment)[0] if scope.is_user else SYSTEM_FILE


def key_place(scope: Scope, environment: Mapping[str, str]) -> Path:
    """The directory with the keys of machines, one file each; it need not exist."""
    return config_file(scope, environment).parent / "ssh"


def read_settings_file(path: Path, origin: Place | None = None) -> SettingsFile:
    """Read one settings file. origin: of a copy. Raises DoraSystemdError (BAD_INPUT)."""
    text = read_file(path)
    document = parse_yaml(decoded(text.data, path), path, allow_empty=True)
    return SettingsFile(path, origin or text.place, text.data, document)


_MOST_FILES = 50
"""Maximum number of module files; they can refer to each other in a circle."""


def written_dataflow(path: str) -> Dataflow:
    """The dataflow in the file `path`, with modules unexpanded. Raises DoraSystemdError."""
    text = decoded(read_file(path).data, Path(path))
    return parse_dataflow(parse_yaml(text, Path(path)), path)


def named_places(dataflow: Dataflow, sight: Sight) -> Iterator[Path]:
    """The directories of modules, and of programs with absolute paths."""
    for node in dataflow.nodes:
        yield from _places(node.raw)
    queue = [
        PurePath(dataflow.source).parent / str(node.raw["module"])
        for node in dataflow.nodes
        if isinstance(node.raw.get("module"), str)
    ]
    for count, path in enumerate(queue):
        if count == _MOST_FILES:
            return
        yield Path(path.parent)
        for raw in _nodes_of(Path(path), sight):
            yield from _places(raw)
            if isinstance(raw.get("module"), str):
                queue.append(path.parent / raw["module"])


def _nodes_of(path: Path, sight: Sight) -> Iterator[dict[str, Any]]:
    try:
        data = sight.read(str(path))
    except OSError as error:
        if error.errno == errno.ENXIO:  # a FIFO: dora would wait for a writer forever
            raise unreadable(path, error) from error
        return
    with suppress(DoraSystemdError):
        document = parse_yaml(decoded(data, path), path)
        nodes = as_mapping(document).get("nodes")
        yield from (node for node in nodes or () if isinstance(node, dict))


def _places(raw: Any) -> Iterator[Path]:
    directory = as_mapping(raw.get("deploy")).get("working_dir")
    if isinstance(directory, str) and directory.startswith("/"):
        yield Path(directory)
    program = raw.get("path")
    if isinstance(program, str) and program.startswith("/"):
        yield Path(program).parent
