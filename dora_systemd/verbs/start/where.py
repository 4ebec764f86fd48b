"""Chooses the user that the nodes run as, and finds their programs with its permissions.

Paths from another user's settings are only checked with that user's permissions: root must not
reveal whether a file exists. Paths on root's own command line are also checked as root, which gives
clearer errors.
"""

import os
import pwd
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dora_systemd.adapters.dora.command import find_dora
from dora_systemd.adapters.host.files import decoded
from dora_systemd.decisions.cell.environment import unit_environment
from dora_systemd.decisions.cell.environment_file import parse_environment_file
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow, called_variables
from dora_systemd.decisions.notice.command import words_of
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.machines import MACHINES
from dora_systemd.decisions.settings.resolve import Settings, with_settings
from dora_systemd.decisions.settings.table import (
    DORA,
    ENV,
    ENV_FILE,
    USER,
    VENV,
    WORKING_DIRECTORY,
)
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.scope import Scope
from dora_systemd.trust.files import read_file, unreadable
from dora_systemd.trust.paths import Place, reached, refusal, user_name
from dora_systemd.trust.programs import Account, account_from
from dora_systemd.trust.sight import Sight, cannot_reach
from dora_systemd.values import quoted, shell_word, shown
from dora_systemd.verbs.start.on_failure import find_command
from dora_systemd.verbs.start.programs import check_program
from dora_systemd.verbs.start.read import Files
from dora_systemd.verbs.start.request import StartRequest

if TYPE_CHECKING:  # most dataflows run on one machine
    from dora_systemd.decisions.machines.member import Member

DEFAULT_USER = "dora"
"""Runs the dataflows whose files belong to root; the package creates this user."""
_MOST_DIGITS = 10  # of a uid
_OWN = Sight()
_UV_HOMES = (".local/bin", ".cargo/bin")
"""Where uv installs itself; ssh and sudo have neither on PATH."""


class Look(NamedTuple):
    """The programs of the nodes, as their user sees them."""

    sight: Sight
    settings: Settings
    user: pwd.struct_passwd | None  # None: the caller, as itself
    directory: str  # absolute, where relative paths begin

    def find_venv(
        self, dataflow: str, environment: Mapping[str, str], is_unbuilt: bool = False
    ) -> str | None:
        """--venv, else the caller's VIRTUAL_ENV, else .venv next to the dataflow, else None.

        is_unbuilt: whether a build replaces an environment whose Python cannot be executed. Raises
        DoraSystemdError for such an environment otherwise.
        """
        given = self.settings[VENV]
        if given is not None:
            return self._checked_venv(str(Path(given).absolute()))
        places = [environment.get("VIRTUAL_ENV", ""), str(Path(dataflow).parent / ".venv")]
        there = [one for one in places if one.startswith("/") and self._is_venv(one)]
        return self._usable(there, is_unbuilt)

    def note_unused_venv(self, environment: Mapping[str, str]) -> str:
        """Format a note about a VIRTUAL_ENV of the caller that the user cannot see, or "".

        The text does not depend on what the caller can see, who may be root.
        """
        named = environment.get("VIRTUAL_ENV", "")
        is_asked = self.settings[VENV] is None and named.startswith("/")
        if not is_asked or self._is_venv(named):
            return ""
        who = f"user {self.user.pw_name} finds" if self.user else "you find"
        return f"VIRTUAL_ENV={shown(named)} is not used: {who} no Python there"

    def _usable(self, venvs: Sequence[str], is_unbuilt: bool) -> str | None:
        """The first one whose Python the user can execute. Raises the error of the first other."""
        problems = []
        for one in venvs:
            try:
                check_program(f"{one}/bin/python", self.sight, self.user)
            except DoraSystemdError as error:
                problems.append(error)
            else:
                return one
        if problems and not is_unbuilt:
            raise problems[0]
        return None

    def _checked_venv(self, venv: str) -> str:
        if not self._is_venv(venv):
            self._blame(VENV, f"{venv}/bin/python", _OWN.exists(f"{venv}/bin/python"))
            raise bad_input(
                f"cannot use {venv} as virtual environment: it has no bin/python",
                f"python3 -m venv {shell_word(venv)}",
            )
        return self._usable([venv], is_unbuilt=False) or venv

    def _is_venv(self, venv: str) -> bool:
        """Whether it is one, also if its Python leads nowhere."""
        return any(self.sight.exists(f"{venv}/{one}") for one in ("bin/python", "pyvenv.cfg"))

    def check_reach(self, dataflow: str) -> None:
        """Raise DoraSystemdError for a working directory, or files, that the user cannot access."""
        if not self.sight.is_directory(self.directory):
            self._blame(WORKING_DIRECTORY, self.directory, _OWN.is_directory(self.directory))
            raise no_directory(self.directory)
        for path in (dataflow, __file__):
            if self.user is not None and not self.sight.exists(path):
                raise cannot_reach(self.user.pw_name, path)

    def find_dora(self, venv: str | None, search_path: str) -> str:
        """Absolute path of the dora command. Raises DoraSystemdError."""
        is_given = self.settings.source(DORA) != "default"
        given = self.settings[DORA] if is_given else None
        try:
            found = find_dora(given, venv, search_path, self.sight)
        except DoraSystemdError:
            if not self.settings.is_in_file(DORA):
                self._blame(DORA, find_dora(given, None, search_path), is_there=True)
            raise
        check_program(found, self.sight, self.user)
        return found

    def _blame(self, setting: Setting[Any], path: str, is_there: bool) -> None:
        """Raise DoraSystemdError for a path that root can see and the user cannot."""
        if self.user is not None and is_there and not self.settings.is_in_file(setting):
            raise cannot_reach(self.user.pw_name, path)


class Where(NamedTuple):
    """Who runs a dataflow, and from where."""

    options: RunnerOptions  # with dora, venv and working directory
    members: "tuple[Member, ...]"  # the other machines
    environment: Mapping[str, str]  # all of Environment=


def find_where(
    scope: Scope, request: StartRequest, files: Files, dataflow: Dataflow, look: Look
) -> Where:
    """Find programs and machines. Raises DoraSystemdError."""
    path, settings = dataflow.source, look.settings
    search_path = request.search_path
    venv = look.find_venv(path, request.environment, request.is_unbuilt)
    variables = given_variables(settings, look.sight)
    look.check_reach(path)
    options = RunnerOptions(
        name=files.name,
        uuid=request.uuid or str(uuid.uuid4()),
        dataflow=path,
        working_directory=look.directory,
        dora=look.find_dora(venv, search_path),
        venv=venv,
        attached=request.attached,
        env_keys=tuple(variables),
        placed=request.placed,
        machine=request.machine,
        head=request.head,
        addresses=request.addresses,
    )
    options = with_settings(options, settings)
    if options.machine:
        options = options.without("on_failure", "black_box")  # the head sends and writes
    if words := words_of(options):
        found = find_command(words, look.sight, look.user, search_path)
        options = options.with_value("on_failure", found)
    if options.hot_reload:
        # Imported late: few dataflows have it, and asyncio is slow to import.
        from dora_systemd.adapters.host.watch import require_watcher

        require_watcher()
    options, members = _spread(dataflow, options, settings, variables)
    called = caller_variables(scope, request, files, dataflow)
    environment = unit_environment(search_path, venv, {**called, **variables})
    return Where(options, members, environment)


def _spread(
    dataflow: Dataflow, options: RunnerOptions, settings: Settings, variables: Mapping[str, str]
) -> "tuple[RunnerOptions, tuple[Member, ...]]":
    """Return the options of this machine's runner, and the members with theirs."""
    is_spread = settings[MACHINES] or any("deploy" in node.raw for node in dataflow.nodes)
    if not (options.machine or is_spread):
        return options, ()
    # Imported late: most dataflows run on one machine.
    from dora_systemd.decisions.machines.spread import part, spread

    if options.machine:
        return part(options, settings), ()
    from dora_systemd.adapters.host.addresses import source_address

    return spread(dataflow, options, settings, variables, os.uname().nodename, source_address)


def caller_variables(
    scope: Scope, request: StartRequest, files: Files, dataflow: Dataflow
) -> dict[str, str]:
    """The variables of the caller that the dataflow names.

    Root's are not for the file of another user, which could read them out.
    """
    is_own = scope.is_user or files.place.uid == os.geteuid()
    return called_variables(dataflow, request.environment if is_own else {})


def find_uv(search_path: str, sight: Sight, home: str = "") -> str:
    """Find uv on a PATH, or where it installs itself below a home directory; "" if it is not there.

    home: "" for no home directory. sight: of the account that runs it.
    """
    places = [*search_path.split(os.pathsep), *(f"{home}/{one}" for one in _UV_HOMES if home)]
    return next((one for one in (f"{at}/uv" for at in places if at) if sight.is_program(one)), "")


def given_variables(settings: Settings, sight: Sight) -> dict[str, str]:
    """The variables of --env and --env-file; --env has precedence, then the last file.

    A start by name reads the files again, and every user sees the variables: a user who has
    replaced a file by a link meanwhile must not get another file read by root.
    """
    variables: dict[str, str] = {}
    for file in settings[ENV_FILE]:
        is_lent = file in settings.lent
        text = _read_lent(file, sight) if is_lent else _read(Path(file).absolute())
        variables |= parse_environment_file(text, file)
    given = settings[ENV]
    return {**variables, **given}


def _read(file: Path) -> str:
    return decoded(read_file(file).data, file)


def _read_lent(file: str, sight: Sight) -> str:
    """An environment file of the user's own settings, read with that user's permissions."""
    try:
        return decoded(sight.read(file), Path(file))
    except PermissionError as error:
        hint = "let the user that the dataflow runs as read it"
        raise refusal(file, "permission denied", hint) from error
    except OSError as error:
        raise unreadable(file, error) from error


def working_directory(files: Files, settings: Settings) -> str:
    """The absolute directory where relative paths begin."""
    given = settings[WORKING_DIRECTORY]
    return str(files.path.parent if given is None else Path(given).absolute())


def choose_user(
    scope: Scope, wanted: str | None, dataflow: Place, directory: str, source: str = "--uid"
) -> pwd.struct_passwd | None:
    """The user for User=, or None if everything runs as the manager's own user.

    Default: the owner of the dataflow file that was read, or DEFAULT_USER if that is root.
    directory: that of the programs. source: of `wanted`, as of Settings. Raises DoraSystemdError.
    """
    named = named_user(scope, wanted, source)
    if scope.is_user or named is not None:
        return named
    try:
        with reached(directory) as (_, place):
            check_identity(dataflow, place)
    except OSError as error:
        # The owner could restore the directory after this, so a path that cannot be checked is
        # refused. The text is that of Look.check_reach(), which does not reveal what root can see.
        raise no_directory(directory) from error
    return _default_entry() if dataflow.uid == 0 else _owner_entry(dataflow.uid, dataflow.path)


def named_user(scope: Scope, wanted: str | None, source: str) -> pwd.struct_passwd | None:
    """The user that a flag or a settings file names, if one does.

    source: of `wanted`, as of Settings. Raises DoraSystemdError.
    """
    if wanted is None:
        return None
    if scope.is_user:
        raise _not_usable(
            "cannot choose the user of a dataflow with --user",
            f"leave {_key(source)} out, or use --system as root",
            source,
        )
    return _entry(wanted, source)


def no_directory(directory: str) -> DoraSystemdError:
    """Return the error for a working directory that is no directory."""
    message = f"cannot use {shown(directory)} as working directory: it is not a directory"
    return bad_input(message, "correct --working-directory")


def account_of(user: pwd.struct_passwd | None) -> Account | None:
    """The account to run children as; None: no change, as for all callers other than root."""
    if user is None or os.geteuid() != 0:
        return None
    return account_from(user)


def check_identity(dataflow: Place, directory: Place) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if another user may have arranged `directory`.

    The programs come from `directory`. No user may get programs executed as another user by placing
    that user's dataflow file next to the programs.
    """
    reason = dataflow.borrowed or directory.borrowed
    if directory.uid not in (0, dataflow.uid):
        reason = reason or f"{user_name(directory.uid)} owns {shown(directory.path)}"
    if directory.is_open:
        reason = reason or f"everybody can write in {shown(directory.path)}"
    if reason:
        raise bad_input(
            f"cannot choose a user by the owner of {shown(dataflow.path)}: {reason}",
            "choose one with --uid USER",
        )


def _key(source: str) -> str:
    return USER.name if source.startswith("/") else source


def _not_usable(message: str, hint: str, source: str) -> DoraSystemdError:
    """The error for a user that a settings file, a variable or a flag names."""
    if source.startswith("/"):
        return bad_input(f"{message} ({USER.name} in {shown(source)})", hint)
    return usage_error(f"{message} ({source})", hint)


def _entry(wanted: str, source: str) -> pwd.struct_passwd:
    refusal = _not_usable(f"cannot find a user {quoted(wanted)}", "see getent passwd", source)
    is_number = wanted.isascii() and wanted.isdigit() and len(wanted) <= _MOST_DIGITS
    return _known(int(wanted) if is_number else wanted, refusal)


def _owner_entry(owner: int, dataflow: str) -> pwd.struct_passwd:
    message = f"cannot choose a user: the owner of {dataflow} is {owner}, which has no name"
    hint = "choose one with --uid USER"
    return _known(owner, bad_input(message, hint))


def _default_entry() -> pwd.struct_passwd:
    message = f"cannot choose a user: the dataflow is root's and there is no user {DEFAULT_USER}"
    hint = f"choose one with --uid USER, or make it: useradd --system {DEFAULT_USER}"
    return _known(DEFAULT_USER, bad_input(message, hint))


def _known(user: int | str, refusal: DoraSystemdError) -> pwd.struct_passwd:
    """The entry of a uid or a name. Raises `refusal` if there is none."""
    try:
        return pwd.getpwuid(user) if isinstance(user, int) else pwd.getpwnam(user)
    except (KeyError, OverflowError) as error:
        raise refusal from error
