"""The project of a deploy: where it is, what cannot be deployed, and which commands build it."""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind, operator_file
from dora_systemd.decisions.releases.build import built_nodes, has_builds, is_moving, lock_places
from dora_systemd.decisions.releases.manifest import refusal
from dora_systemd.decisions.settings.table import ENV_FILE, USER, VENV, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import settings_path
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import Place, exists, is_directory
from dora_systemd.trust.sight import Sight, sight_of
from dora_systemd.values import as_list, shown
from dora_systemd.verbs.start.plan import Plan, make_plan
from dora_systemd.verbs.start.read import read_files
from dora_systemd.verbs.start.request import DEFAULT_FILE, StartRequest, path_of
from dora_systemd.verbs.start.where import account_of, find_uv


@dataclass(frozen=True)
class Source:
    """A project."""

    root: str  # its directory
    origin: Place  # of its files, whose owner limits their settings
    plan: Plan  # of a start from root
    named: tuple[str, ...]  # files that the dataflow names, relative to root
    # the contents of files that decide what root does, None for a missing file
    read: Mapping[str, bytes | None]
    # dora, uv: the commands that have something to build, "" otherwise
    dora: str = ""
    uv: str = ""
    is_moving: bool = False  # whether these may build another program from the same files
    sent: str = ""  # from where another host has sent the project, or ""
    revision: str = ""  # of git, for a project that was sent

    @property
    def own_venv(self) -> str | None:
        """The virtual environment of the nodes, relative to root; None for one that is given."""
        if self.plan.settings.is_given(VENV):
            return None
        venv = self.plan.options.venv
        # uv makes one for the project, whichever one the caller has activated.
        if not venv or (self.uv and not _is_below(venv, self.root)):
            venv = str(Path(self.plan.options.dataflow).parent / ".venv")
        return os.path.relpath(venv, self.root) if _is_below(venv, self.root) else None

    @property
    def dataflow(self) -> str:
        """The dataflow file, relative to root."""
        return os.path.relpath(self.plan.options.dataflow, self.root)


def find_source(scope: Scope, request: StartRequest, want_build: bool = True) -> Source:
    """The project of the file or directory that `request` names.

    want_build: what it needs is built in the release. Raises DoraSystemdError.
    """
    path = project_file(request)
    # Unchanged without an argument: then the error for a missing file has another hint.
    given = request if path_of(request) == path else request._replace(dataflow=str(path))
    wanted = given._replace(is_unbuilt=want_build)
    files = read_files(wanted)
    plan, dataflow = make_plan(scope, wanted, files), files.dataflow()
    directory = plan.options.working_directory
    root = project_root(path, directory)
    _check(plan, dataflow, root, want_build)
    environment_files = plan.settings[ENV_FILE]
    named = named_paths(dataflow, directory, root, environment_files)
    beside = files.beside
    origin = beside.place if beside and beside.place.changeable else files.place
    read: dict[str, bytes | None] = {
        os.path.relpath(one, root): read_file(one).data
        for one in environment_files
        if _is_below(os.path.normpath(one), root) and one not in plan.settings.lent
    }
    read[os.path.relpath(path, root)] = files.text.data
    read[os.path.relpath(settings_path(str(path)), root)] = beside.data if beside else None
    builders = find_builders(plan, dataflow, root) if want_build else ("", "")
    if plan.missing and not any(builders):
        raise plan.missing
    moves = bool(builders[0]) and is_moving(dataflow)
    return Source(root, origin, plan, named, read, *builders, is_moving=moves)


def project_file(request: StartRequest) -> Path:
    """The dataflow file that `request` names, itself or by its directory."""
    path = path_of(request)
    path = path / DEFAULT_FILE if is_directory(path) else path
    return Path(os.path.normpath(path))


def named_paths(
    dataflow: Dataflow, directory: str, root: str, more: Iterable[str]
) -> tuple[str, ...]:
    """The files below `root` that belong to a release in any case, relative to it.

    directory: the working directory. more: other absolute paths that count if they are below.
    """
    path = dataflow.source
    named = (path, settings_path(path), *_programs(dataflow, directory), *more)
    inside = (os.path.normpath(one) for one in named)
    relative = (os.path.relpath(one, root) for one in inside if _is_below(one, root))
    return tuple(dict.fromkeys(relative))


def require_same(source: Source, tree: Path) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the copy differs from the files that root has read.

    The user of the nodes has read the project for root, and can forge files of other users.
    """
    for path, data in source.read.items():
        copy = tree / path
        text = read_file(copy) if os.path.lexists(copy) else None
        # A build may have replaced the file by a link to a file that its user can change later.
        is_ours = text is None or text.place.is_roots or os.geteuid() != 0
        if (text and text.data) != data or not is_ours:
            hint = "deploy again; a build must not change it"
            raise refusal(path, "it changed while it was copied or built", hint)


def released(source: Source, request: StartRequest, tree: Path, uuid: str) -> StartRequest:
    """The request to start the copy in `tree`, with what was found at the source."""
    options, user = source.plan.options, source.plan.user
    given: dict[str, object] = {}
    if source.plan.settings.is_given(WORKING_DIRECTORY):
        place = os.path.relpath(options.working_directory, source.root)
        given[WORKING_DIRECTORY.name] = os.path.normpath(tree / place)
    if venv := own_venv(source, tree) or options.venv:
        given[VENV.name] = venv
    if user is not None:
        given[USER.name] = user.pw_name
    return request._replace(
        dataflow=str(tree / source.dataflow),
        name=options.name,
        flags={**request.flags, **given},
        uuid=uuid,
        origin=source.origin,
    )


def own_venv(source: Source, tree: Path) -> str | None:
    """The virtual environment that the build has made in the release in `tree`, or None."""
    venv = source.own_venv
    return str(tree / venv) if venv and exists(tree / venv / "bin/python") else None


def source_notes(source: Source, tree: Path) -> Iterator[str]:
    """Yield notes about a release of this project in `tree` (human-readable)."""
    if (venv := source.plan.options.venv) and not own_venv(source, tree):
        yield f"all releases share the virtual environment {shown(venv)}: pip changes all of them"


def project_root(path: Path, directory: str) -> str:
    """The directory of the file, or the working directory if that is above it.

    Raises DoraSystemdError (BAD_INPUT) if neither is above the other one.
    """
    directory = os.path.normpath(directory)
    above = str(path.parent)
    if _is_below(directory, above) or directory == above:
        return above
    if _is_below(above, directory) and directory != "/":
        return directory
    raise _refusal(
        f"its working directory {shown(directory)} is not in the project",
        "give a directory below the file, or above it, with --working-directory",
    )


def _check(plan: Plan, dataflow: Dataflow, root: str, want_build: bool) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for what a release cannot do yet."""
    if plan.options.hot_reload:
        reason = "hot reload is on, and the files of a release do not change"
        raise _refusal(reason, "deploy with --no-hot-reload, or use doractl start")
    if plan.options.uv:
        hint = "deploy with --no-uv: then uv makes .venv from uv.lock, also for build: pip install"
        raise _refusal("uv is on, and would write to the release", hint)
    if plan.members:
        reason = "it runs on several machines"
        raise _refusal(reason, "bring the files to each of them, and use doractl start")
    for node in dataflow.nodes:
        if node.git and not want_build:
            reason, hint = "its program comes from git", "deploy without --no-build"
        elif node.path.startswith(f"{root}/"):
            reason = f"its path {shown(node.path)} would be outside of the release"
            hint = f"write it relative to {shown(root)}"
        else:
            reason, hint = _trouble_of_path(node, plan.options.working_directory, root)
        if reason:
            raise _refusal(f"node {node.id}: {reason}", hint)


def _trouble_of_path(node: Node, directory: str, root: str) -> tuple[str, str]:
    """Return why a node's path leads to a file that a release would not have, and a hint; or ""."""
    place = os.path.normpath(Path(directory, node.working_directory, node.path))
    if ".." not in node.path.split("/") or _is_below(place, root) or not exists(place):
        return "", ""
    above = os.path.commonpath([root, place])
    hint = "move it into the project"
    if above != "/":
        path = shown(os.path.relpath(place, above))
        hint = f"use --working-directory {shown(above)}, and write the path from there: {path}"
    return f"its path {shown(node.path)} leads out of {shown(root)}", hint


def _programs(dataflow: Dataflow, working_directory: str) -> Iterator[str]:
    """The files that nodes and operators are started from, absolute, as far as they have a path."""
    for node in dataflow.nodes:
        raw = node.raw
        operators = [raw.get("operator"), *as_list(raw.get("operators"))]
        values = [node.path, raw.get("module"), *(operator_file(one) for one in operators)]
        for one in values:
            if isinstance(one, str) and one and "://" not in one:
                directory = Path(working_directory, node.working_directory)
                yield str(directory / one)


def _is_below(path: str, directory: str) -> bool:
    return path.startswith(f"{directory.rstrip('/')}/")


def _refusal(reason: str, hint: str) -> DoraSystemdError:
    return bad_input(f"cannot deploy: {reason}", hint)


def find_builders(plan: Plan, dataflow: Dataflow, root: str) -> tuple[str, str]:
    """The paths of dora and of uv, "" for one that has nothing to do.

    dataflow: of the plan, as written. root: of the project.
    """
    has_nodes = bool(built_nodes(dataflow))
    modules = [node.raw.get("module") for node in dataflow.nodes if node.kind is NodeKind.MODULE]
    relative = os.path.relpath(plan.options.dataflow, root)
    is_locked = any(exists(f"{root}/{place}") for place in lock_places(relative))
    is_given = plan.settings.is_given(VENV)
    uv = ""
    if modules or (is_locked and not is_given):
        with sight_of(account_of(plan.user)) as sight:
            directory = Path(plan.options.dataflow).parent
            has_nodes = has_nodes or any(_has_builds(directory, one, sight) for one in modules)
            path = plan.environment.get("PATH", "")
            uv = find_uv(path, sight) if is_locked and not is_given else ""
    return plan.options.dora if has_nodes else "", uv


def _has_builds(directory: Path, module: object, sight: Sight) -> bool:
    """Whether the file of a module requires a build; dora reports a file that is not readable."""
    path = directory / str(module)
    try:
        return has_builds(parse_yaml(decoded(sight.read(str(path)), path), path))
    except (OSError, DoraSystemdError):
        return False
