"""The sandbox of a plan: the paths that must stay accessible, and what a scope cannot enforce."""

import pwd
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from dora_systemd.adapters.dora.preparation import PACKAGE
from dora_systemd.adapters.host.files import absolute_path
from dora_systemd.decisions.cell.launch import LaunchPlan, python_of
from dora_systemd.decisions.cell.limits import has_cpus, limits_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import has_process_rights, rights_of
from dora_systemd.decisions.cell.uv import uv_project
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.needs.units import device_entries, needs_can
from dora_systemd.decisions.needs.words import needs_of
from dora_systemd.decisions.notice.command import is_command, words_of
from dora_systemd.decisions.properties.sandbox import Sandbox, loose_paths, odd_paths, widened_paths
from dora_systemd.decisions.settings.limits import DEVICE, REALTIME
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import NETWORK, SANDBOX, WRITABLE
from dora_systemd.decisions.settings.table import PROPERTY
from dora_systemd.errors import bad_input
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import firm_part
from dora_systemd.trust.programs import account_from
from dora_systemd.trust.sight import Sight
from dora_systemd.values import shown
from dora_systemd.verbs.start.read import named_places
from dora_systemd.verbs.start.where import Look

_MAX_USER_NAMESPACES = Path("/proc/sys/user/max_user_namespaces")
_IDENTITY = 65536
_CAPABILITIES = ("AmbientCapabilities", "CapabilityBoundingSet")
_UV_PLACES = (".cache/uv", ".local/share/uv")
"""Where uv writes below the home directory, see `uv cache dir` and `uv python dir`."""


def make_sandbox(
    scope: Scope,
    look: Look,
    dataflow: Dataflow,
    launch: LaunchPlan,
    offers_identity: bool | None = None,
) -> Sandbox:
    """The sandbox of the settings. Raises DoraSystemdError for a path that does not exist.

    offers_identity: whether the machine can create a user namespace; None: find out.
    """
    sight, settings, user, options = look.sight, look.settings, look.user, launch.options
    rights = rights_of(options)
    given = [_checked(path, sight, user) for path in settings[WRITABLE]]
    denied = [] if user is None else [path for path in given if not sight.is_writable(path)]
    needed = tuple(dict.fromkeys(_existing(_needed(dataflow, launch, sight), sight)))
    writable = (*given, *_existing(_written_by_uv(options, user, sight), sight))
    return Sandbox(
        level=settings[SANDBOX],
        network=settings[NETWORK],
        is_user=scope.is_user,
        is_root=user is not None and user.pw_uid == 0,
        has_devices=bool(settings[DEVICE] or device_entries(needs_of(options)))
        or _names(settings, "DeviceAllow"),
        has_can=needs_can(needs_of(options)),
        is_realtime=settings[REALTIME] is not None or any(one.priority for one in rights),
        has_rights=has_process_rights(rights) or any(map(has_cpus, limits_of(options))),
        # In a user namespace the given capabilities would have no effect.
        has_identity=_has_identity(user, offers_identity) and not _names(settings, *_CAPABILITIES),
        needed=needed,
        writable=writable,
        firm={} if scope.is_user else _firm((*needed, *writable), user),
        directory=str(scope.cell_directory(options.name)),
        denied=denied,
        user="" if user is None else user.pw_name,
    )


def _firm(paths: Sequence[str], user: pwd.struct_passwd | None) -> dict[str, str]:
    """Return the part of each path that systemd may mount for `user`.

    The user's own view proves nothing: a program of that user can trace the child that checks the
    paths, and forge its answers.
    """
    account = None if user is None else account_from(user)
    uid, groups = (0, ()) if account is None else (account.uid, (account.gid, *account.groups))
    return {path: firm_part(path, uid, groups) for path in paths}


def sandbox_warnings(sandbox: Sandbox) -> Iterator[str]:
    """Warnings about what a user's manager cannot enforce, and about paths that stay accessible."""
    for path in odd_paths(sandbox):
        yield f"the sandbox cannot hide what is around {shown(path)}, whose name no mount can have"
    for place, path in {place: path for path, place in loose_paths(sandbox)}.items():
        yield f"the sandbox cannot hide {place}: users other than root can replace {shown(path)}"
    for place, path in {place: path for path, place in widened_paths(sandbox)}.items():
        yield f"the nodes may write all of {shown(place)}: its user could replace {shown(path)}"
    for path in sandbox.denied:
        change = f"chown {sandbox.user} {shlex.quote(path)}"
        yield f"the nodes run as {sandbox.user}, who cannot write {shown(path)}: {change}"
    if not sandbox.is_user:
        return
    if sandbox.level == "strict":
        yield "the sandbox protects no files in user scope, strict or not"
    if sandbox.network == "loopback":
        yield "the network cannot be limited to the loopback interface in user scope"
    if sandbox.network == "private":
        yield "a private network in user scope needs user namespaces, see systemd.exec(5)"


def _has_identity(user: pwd.struct_passwd | None, is_offered: bool | None) -> bool:
    """Whether `user` fits into a user namespace with the first 65536 ids, and the machine has one.

    Directory services assign higher ids.
    """
    is_known = user is None or max(user.pw_uid, user.pw_gid) < _IDENTITY
    return is_known and (_offers_identity() if is_offered is None else is_offered)


def _offers_identity() -> bool:
    """Whether this machine can create one: kernels may refuse, and containers may have fewer ids.

    See namespaces(7) and user_namespaces(7).
    """
    try:
        has_all = all(_maps_identity(Path("/proc/self", one)) for one in ("uid_map", "gid_map"))
        return has_all and int(_MAX_USER_NAMESPACES.read_text()) > 0
    except OSError:
        return False


def _maps_identity(path: Path) -> bool:
    rows = ([int(number) for number in line.split()] for line in path.read_text().splitlines())
    return any(inside == 0 and count >= _IDENTITY for inside, _, count in rows)


def _names(settings: Settings, *keys: str) -> bool:
    """Whether the settings contain one of these properties."""
    return any(one.partition("=")[0] in keys for one in settings[PROPERTY])


def _checked(path: str, sight: Sight, user: pwd.struct_passwd | None) -> str:
    absolute = str(Path(path).absolute())
    if not sight.exists(absolute):
        make = "mkdir -p" if user is None else f"install -d -o {user.pw_name}"
        raise bad_input(
            f"cannot let the nodes write {shown(absolute)}: there is no such file",
            f"{make} {shlex.quote(absolute)}, or correct --writable",
        )
    return absolute_path(absolute)


def _existing(paths: Iterator[Path], sight: Sight) -> Iterator[str]:
    yield from (absolute_path(str(path)) for path in paths if sight.exists(str(path)))


def _needed(dataflow: Dataflow, launch: LaunchPlan, sight: Sight) -> Iterator[Path]:
    """The paths of the dataflow, its programs, their interpreters, and this package."""
    options, session = launch.options, launch.session
    yield Path(options.dataflow).parent
    yield Path(options.working_directory)
    yield from (Path(sys.prefix), Path(sys.base_prefix), PACKAGE.parent)
    for program in (options.dora, python_of(launch)):
        # A virtual environment links to the Python that it was created from.
        yield from (_prefix(Path(program)), _prefix(Path(sight.real(program))))
    yield from map(Path, words[:1] if is_command(words := words_of(options)) else ())
    yield from named_places(dataflow, sight)
    yield from map(Path, (*session.directories.values(), *session.envs.values()))


def _prefix(program: Path) -> Path:
    return program.parent.parent if program.parent.name == "bin" else program.parent


def _written_by_uv(
    options: RunnerOptions, user: pwd.struct_passwd | None, sight: Sight
) -> Iterator[Path]:
    if options.uv and user is not None:
        directory = options.working_directory
        # `uv run` brings .venv and uv.lock up to date, next to the pyproject.toml.
        yield from (Path(one) for one in (directory, uv_project(directory, sight.read)) if one)
        yield from (Path(user.pw_dir, place) for place in _UV_PLACES)
