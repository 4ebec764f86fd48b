"""The build of a release or a project: its commands, what it prints, and its transient unit. Pure.

The unit of a release's build has the user, the sandbox and the network of the dataflow's unit. What
is different: a build may write the tree that it builds, and sees no other release; it has no
credentials, no rights of single nodes, and few CPU shares compared with running dataflows.
"""

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePath

from dora_systemd.decisions.cell.environment import environment_entries
from dora_systemd.decisions.cell.uv import LOCK
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import Node, NodeKind
from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.structs import MS_REC
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.decisions.releases.manifest import MOST_BYTES
from dora_systemd.terminal_text import short_line, without_sequences
from dora_systemd.values import INFINITY, SECOND, as_list, as_mapping

_LONGEST = 300
"""Maximum characters of a line of the build in an error or on a terminal."""
_OF_NODE = r"(?P<node>[\w.-]+): +(?P<level>stdout|stderr|[A-Z]+) +(?P<text>\S.*)"
"""A line that dora prints: "a: stdout   text", or "a: INFO     running build command"."""
_FAILED_NODE = r"failed to build node `(?P<node>[^`\n]+)`"
_UV_ERROR = re.compile(r"^(?:error: | +× )", re.MULTILINE)
_UV_CAUSE = r"\n +(?:cause:|Caused by:|[├╰]─▶) *"
_UNATTENDED = {"PIP_NO_INPUT": "1", "GIT_TERMINAL_PROMPT": "0"}
"""Variables that prevent questions, which nobody could answer in a unit."""
_HOMELESS = {
    "UV_NO_CACHE": "1",
    "UV_PYTHON_DOWNLOADS": "never",
    "UV_PYTHON_PREFERENCE": "only-system",
}
"""uv keeps its cache and its Pythons in the home directory."""
_ALWAYS = {
    # Bytecode is valid by its source's content, for the files get new times. Python, pip and uv
    # have this mode by this variable alone.
    "SOURCE_DATE_EPOCH": "315532800",
    # _COMPILE does that when all packages are installed.
    "UV_COMPILE_BYTECODE": "0",
    "UV_LINK_MODE": "copy",
    # The sandbox makes homes read-only, and a Python in one of them is no part of the release.
    **_HOMELESS,
    **_UNATTENDED,
}
_COMPILE = (
    '[ ! -x "$1/bin/python" ] || "$1/bin/python" -I -m compileall -qq -f -s "$2" '
    '--invalidation-mode checked-hash "$1/lib"; true'
)
"""Compiles what is in a virtual environment: equal sources become equal files, which releases
share, for the path of the release is not in them. Packages have files that no Python can compile.
"""


@dataclass(frozen=True)
class BuildTask:
    """The task of the program in a build's unit."""

    # name, uuid: of the dataflow; of a build of a project its file, and ""
    name: str
    uuid: str
    release: str  # its id
    directory: str  # where the commands run, in their order
    commands: tuple[tuple[str, ...], ...]
    is_shown: bool = False  # whether doractl shows standard output, and not the journal


def format_task(task: BuildTask) -> str:
    """The task as one argument of a command line."""
    return json.dumps(asdict(task))


def parse_task(text: str) -> BuildTask:
    """The inverse of format_task(). Raises ValueError, TypeError or KeyError for another text."""
    value = json.loads(text)
    return BuildTask(**{**value, "commands": tuple(map(tuple, value["commands"]))})


def build_unit(name: str) -> str:
    """The unit that builds releases of the dataflow `name`."""
    return f"doractl-build-{name}.service"


def built_nodes(dataflow: Dataflow) -> list[str]:
    """The ids of the nodes that `dora build` has something to do for."""
    return [node.id for node in dataflow.nodes if node.git or any(_builds(node))]


def _builds(node: Node) -> Iterator[object]:
    yield node.build
    for operator in (node.raw.get("operator"), *as_list(node.raw.get("operators"))):
        yield as_mapping(operator).get("build")


def has_builds(value: object) -> bool:
    """Whether a module's document has a key that `dora build` reads; those of its modules count."""
    left, seen = [value], set[int]()  # an alias of YAML may lead anywhere, and back
    while left:
        one = left.pop()
        if id(one) in seen or not isinstance(one, Mapping | list):
            continue
        seen.add(id(one))
        if isinstance(one, Mapping) and any(one.get(key) for key in ("build", "git", "module")):
            return True
        left += one.values() if isinstance(one, Mapping) else one
    return False


def is_moving(dataflow: Dataflow) -> bool:
    """Return whether equal files may build another program, from a repository's newest commit.

    True for a module, too, which is not read and may name a repository.
    """
    return any(
        node.kind is NodeKind.MODULE or (node.git and not {"rev", "tag"} & node.raw.keys())
        for node in dataflow.nodes
    )


def lock_places(dataflow: str) -> tuple[str, ...]:
    """Return where a uv.lock may be: next to the dataflow file, or at the top of the project."""
    return tuple(str(PurePath(one, LOCK)) for one in (PurePath(dataflow).parent, "."))


def build_commands(
    files: Collection[str], place: str, dataflow: str, uv: str, dora: str, venv: str | None = None
) -> tuple[tuple[str, ...], ...]:
    """The commands of a build.

    files: of the project, which is at `place` while it is built. dataflow: its path there. uv,
    dora: paths of these commands, "" if there is nothing to do for them. venv: the virtual
    environment that they may make, relative to `place`, or None.
    """
    lock = next((one for one in lock_places(dataflow) if one in files), None)
    sync = ("sync", "--frozen", "--directory", str(PurePath(place, lock or "").parent))
    found: list[tuple[str, ...]] = [(uv, *sync)] if uv and lock else []
    found += [(dora, "build", "--local", str(PurePath(place, dataflow)))] if dora else []
    if found and venv is not None:
        found.append(("/bin/sh", "-c", _COMPILE, "compile", str(PurePath(place, venv)), place))
    return tuple(found)


def project_commands(
    dataflow: str, lock: str, uv: str, dora: str, with_uv: bool
) -> tuple[tuple[str, ...], ...]:
    """The commands that build a project where it is.

    lock: the directory of its uv.lock, or "". uv, dora: these commands. with_uv: of dora build.
    """
    sync = [(uv, "sync", "--directory", lock)] if lock else []
    return (*sync, (dora, "build", "--local", *(("--uv",) if with_uv else ()), dataflow))


def project_environment(
    given: Mapping[str, str], venv: str | None, more: Sequence[str], has_home: bool
) -> dict[str, str]:
    """Return the variables of a build in the project's directory, from those of the nodes.

    venv: of the project, which uv may create, or None. more: directories for the end of PATH.
    has_home: whether the account has a writable home directory, for caches.
    """
    always = {**_UNATTENDED, **({} if has_home else _HOMELESS)}
    path = given.get("PATH", "")
    own = {}
    if venv is not None:
        path = f"{venv}/bin:" + path.removeprefix(f"{venv}/bin:")
        own = {"VIRTUAL_ENV": venv, "UV_PROJECT_ENVIRONMENT": venv}
    return {**always, **given, **own, "PATH": ":".join([path, *more])}


def build_environment(
    given: Mapping[str, str], venv: str | None, former_venv: str | None, more: str = ""
) -> dict[str, str]:
    """Return the variables of a build, from those of the nodes, which have precedence.

    venv: which the build may create, None for a given one. former_venv: its programs come first on
    PATH otherwise. more: a directory of programs that come after those of `venv`, or "".
    """
    if venv is None:
        return {**_ALWAYS, **given}
    path = given.get("PATH", "").removeprefix(f"{former_venv}/bin:")
    first = f"{venv}/bin:{more}:" if more else f"{venv}/bin:"
    own = {"PATH": first + path, "VIRTUAL_ENV": venv, "UV_PROJECT_ENVIRONMENT": venv}
    return {**_ALWAYS, **given, **own}


def shown_line(line: str) -> str:
    """A line of the build as people read it: "NODE: TEXT" of what dora prints for a node."""
    text = without_sequences(line).strip()
    found = re.fullmatch(_OF_NODE, text)
    return short_line(f"{found['node']}: {found['text']}" if found else text, _LONGEST)


def is_output(line: str) -> bool:
    """Whether a build command has printed the line, and not dora itself."""
    found = re.fullmatch(_OF_NODE, without_sequences(line).strip())
    return found is not None and not found["level"].isupper()


def parse_build_error(reason: str, printed: str) -> str:
    """Name the node in a reason that dora gives. printed: the whole output of dora build."""
    found = re.search(_FAILED_NODE, without_sequences(printed))
    return f"node {found['node']}: {reason}" if found and reason else reason


def parse_uv_error(printed: str) -> str:
    """The last error in uv's output with its causes, on one line; "" if uv names none."""
    text = without_sequences(printed)
    *_, begin = (0, *(found.end() for found in _UV_ERROR.finditer(text)))
    error, _, _ = text[begin:].partition("\nhint: ")
    return short_line(f"uv: {re.sub(_UV_CAUSE, ': ', error)}", _LONGEST) if begin else ""


_OF_NODES = (
    *(
        "LoadCredential",
        "ImportCredential",
        "LogRateLimit",
        "CPUScheduling",
        "IOScheduling",
        "Nice",
    ),
    *("CPUWeight", "IOWeight", "StartupCPU", "StartupIO", "LimitRTPRIO", "LimitNICE", "KillMode"),
    *("OOMScoreAdjust", "AmbientCapabilities", "TasksMax", "Environment"),
)
"""Prefixes of the properties that a build must not have, or has other values of."""
_SHARES = 10
"""CPUWeight= and IOWeight=; the default of all others is 100."""
_STOP = 5 * SECOND
_MOST_TASKS = 4096
_MEMORY = "50%"


def build_properties(
    own: Mapping[str, Property],
    tree: str,
    place: str,
    releases: str,
    environment: Mapping[str, str],
    timeout: int,
    is_user: bool,
) -> dict[str, Property]:
    """Return all properties but ExecStart= and standard input.

    own: of the unit of the dataflow, without those of its runner. tree: the directory that is
    built, which the unit sees as `place`, below `releases`. timeout: µs.
    """
    kept = {slot: one for slot, one in own.items() if not _is_of_nodes(slot)}
    if not any(slot.startswith("MemoryMax") for slot in kept):
        kept = with_assignments(kept, [f"MemoryMax={_MEMORY}"])
    binds, hidden = (_values(kept, key) for key in ("BindPaths", "TemporaryFileSystem"))
    kept |= _of_builds(environment) | typed(
        NotifyAccess="main",
        # A venv and a program can contain the path that they were built at.
        TemporaryFileSystem=(*hidden, (releases, "ro")),
        BindPaths=(*binds, (tree, place, False, MS_REC)),
        TimeoutStartSec=timeout,
        LimitFSIZE=MOST_BYTES,
    )
    # A user's manager has no mounts without a user namespace, see systemd.exec(5).
    return with_assignments(kept, ["PrivateUsers=yes"]) if is_user else kept


def project_build_properties(user: str, environment: Mapping[str, str]) -> dict[str, Property]:
    """The properties of a build of a project where it is, but ExecStart= and the streams.

    It has the rights of `user` and no sandbox, as if that user had built: caches in the home
    directory count.
    """
    own = typed(User=user, NoNewPrivileges=True, TimeoutStartSec=INFINITY)
    return _of_builds(environment) | own


def _of_builds(environment: Mapping[str, str]) -> dict[str, Property]:
    return typed(
        Type="oneshot",
        WorkingDirectory="/",
        Environment=environment_entries(environment),
        TimeoutStopSec=_STOP,
        KillMode="control-group",
        CPUWeight=_SHARES,
        IOWeight=_SHARES,
        TasksMax=_MOST_TASKS,
    )


def _is_of_nodes(slot: str) -> bool:
    """Whether it has such a prefix, or is of [Unit]: a build starts no other units."""
    row = TABLE.get(slot.removesuffix("~").removesuffix("Soft"))
    return slot.startswith(_OF_NODES) or (row is not None and row.section == "Unit")


def _values(properties: Mapping[str, Property], key: str) -> tuple[object, ...]:
    return tuple(properties[key].value) if key in properties else ()
