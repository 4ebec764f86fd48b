"""Finds and checks the files of a dataflow, with the permissions of the user that it will run as.

Paths from another user's settings are only checked with that user's permissions: root must not
reveal whether a file exists. Paths on root's own command line are also checked as root, which gives
clearer errors.
"""

import os
import pwd
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dora_systemd.adapters.dora.command import find_dora
from dora_systemd.adapters.host.files import absolute_path, decoded, parse_yaml
from dora_systemd.decisions.cell.launch import LaunchPlan
from dora_systemd.decisions.descriptor.dataflow import (
    BuildSession,
    Dataflow,
    parse_session,
    session_path,
)
from dora_systemd.decisions.descriptor.nodes import NodeKind
from dora_systemd.decisions.settings.credentials import CREDENTIALS, MAX_SIZE
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.decisions.settings.table import DORA, VENV, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.files import unreadable
from dora_systemd.trust.paths import reached
from dora_systemd.trust.sight import Sight, cannot_reach
from dora_systemd.values import shown
from dora_systemd.verbs.start.account import no_directory

_OWN = Sight()


@dataclass(frozen=True)
class Look:
    """sight: that of `user`, which is None if the caller runs the dataflow as itself."""

    sight: Sight
    settings: Settings
    user: pwd.struct_passwd | None

    def find_venv(self, dataflow: str, environment: Mapping[str, str]) -> str | None:
        """--venv, else the caller's VIRTUAL_ENV, else .venv beside the dataflow, else None."""
        given = self.settings[VENV]
        if given is not None:
            return self._checked_venv(str(Path(given).absolute()))
        places = [environment.get("VIRTUAL_ENV", ""), str(Path(dataflow).parent / ".venv")]
        return next((one for one in places if one.startswith("/") and self._is_venv(one)), None)

    def _checked_venv(self, venv: str) -> str:
        if not self._is_venv(venv):
            self._blame(VENV, f"{venv}/bin/python", _OWN.exists(f"{venv}/bin/python"))
            raise DoraSystemdError(
                f"cannot use {venv} as virtual environment: it has no bin/python",
                f"python3 -m venv {venv}",
                ExitCode.BAD_INPUT,
            )
        return venv

    def _is_venv(self, venv: str) -> bool:
        return self.sight.exists(f"{venv}/bin/python")

    def check_reach(self, dataflow: str, directory: str) -> None:
        """Raise DoraSystemdError for a working directory, or files, that the user cannot access."""
        if not self.sight.is_directory(directory):
            self._blame(WORKING_DIRECTORY, directory, _OWN.is_directory(directory))
            raise no_directory(directory)
        for path in (dataflow, __file__):
            if self.user is not None and not self.sight.exists(path):
                raise cannot_reach(self.user.pw_name, path)

    def find_dora(self, venv: str | None, search_path: str) -> str:
        """Absolute path of the dora command. Raises DoraSystemdError."""
        is_given = self.settings.source(DORA) != "default"
        given = self.settings[DORA] if is_given else None
        try:
            return find_dora(given, venv, search_path, self.sight)
        except DoraSystemdError:
            if not self._is_named_in_file(DORA):
                self._blame(DORA, find_dora(given, None, search_path), is_there=True)
            raise

    def _blame(self, setting: Setting[Any], path: str, is_there: bool) -> None:
        """Raise DoraSystemdError for a path that root can see and the user cannot."""
        if self.user is not None and is_there and not self._is_named_in_file(setting):
            raise cannot_reach(self.user.pw_name, path)

    def _is_named_in_file(self, setting: Setting[Any]) -> bool:
        return self.settings.source(setting).startswith("/")

    def read_lent(self, file: str) -> str:
        """Read an environment file of the user's own settings, with that user's permissions."""
        try:
            return decoded(self.sight.read(file), Path(file))
        except OSError as error:
            raise unreadable(file, error) from error

    def read_session(self, dataflow: str) -> BuildSession:
        """The session that `dora build` has saved, if any. Raises DoraSystemdError."""
        path = Path(session_path(dataflow))
        try:
            text = decoded(self.sight.read(str(path)), path)
        except OSError:
            return BuildSession()
        return parse_session(parse_yaml(text, path, allow_empty=True))


def plan_notes(scope: Scope, dataflow: Dataflow, launch: LaunchPlan, look: Look) -> Iterator[str]:
    """A line for each thing to know or to do."""
    dynamic = [node.id for node in dataflow.nodes if node.kind is NodeKind.DYNAMIC]
    # No other process can reach the ports of a private network.
    if dynamic and look.settings[NETWORK] != "private":
        nodes = f"node{'s' if len(dynamic) > 1 else ''} {', '.join(dynamic)}"
        variables = f'eval "$(doractl {scope.flag} env {launch.options.name})"'
        yield f"start the dynamic {nodes} in another terminal, after: {variables}"
    path, uv = shown(dataflow.source), "--uv " if launch.options.uv else ""
    if not any(one.build or one.git for one in dataflow.nodes):
        return
    # `dora run` always builds first.
    if not launch.session.directories:
        yield f"no build of {path} is found; to build it: dora build {uv}{path}"
    elif _is_build_old(dataflow, look):
        yield f"{path} is newer than its last build; to build again: dora build {uv}{path}"


def _is_build_old(dataflow: Dataflow, look: Look) -> bool:
    """Whether the dataflow has changed since `dora build`."""
    session = str(session_path(dataflow.source))
    return look.sight.modified_ns(dataflow.source) > look.sight.modified_ns(session)


def credential_files(settings: Settings) -> dict[str, str]:
    """The absolute path of each credential by its name."""
    return {name: absolute_path(file) for name, file in settings[CREDENTIALS].items()}


def check_credentials(scope: Scope, files: Mapping[str, str]) -> None:
    """Raise DoraSystemdError for a file that systemd could not read, or if all are too large.

    In system scope root reads the files, so one that only the caller cannot read is fine. systemd
    reads them at every start, and follows the path each time: if others could replace a part of the
    path by a link, nodes would get any file that root can read. So only root may be able to.
    """
    is_reader = scope.is_user or os.geteuid() == 0
    total = 0
    for name, file in files.items():
        try:
            total += _checked_size(name, file)
            if not scope.is_user:
                _check_firm(name, file)
        except PermissionError as error:
            if is_reader:
                reason, hint = "permission denied", "let the calling user read it"
                raise _refusal(name, file, reason, hint, ExitCode.NO_PERMISSION) from error
        except OSError as error:
            reason, hint = "there is no such file", "give the path of a file that has the secret"
            raise _refusal(name, file, reason, hint) from error
        if total > MAX_SIZE:
            reason, hint = "it is too large", "all credentials together have at most 1 MiB"
            raise _refusal(name, file, reason, hint)


def _checked_size(name: str, file: str) -> int:
    status = Path(file).stat()
    if stat.S_ISDIR(status.st_mode):
        raise _refusal(name, file, "it is a directory", "give each file in it a name")
    if not stat.S_ISREG(status.st_mode):
        raise _refusal(name, file, "it is not a regular file", "give a file")
    if not os.access(file, os.R_OK):
        raise PermissionError
    return status.st_size


def _check_firm(name: str, file: str) -> None:
    with reached(file) as (_, place):
        if not place.is_roots and os.geteuid() == 0:
            reason = "users other than root could replace it"
            hint = "systemd reads it as root: keep it where only root can write, as in /etc"
            raise _refusal(name, file, reason, hint, ExitCode.NO_PERMISSION)


def _refusal(
    name: str, file: str, reason: str, hint: str, code: ExitCode = ExitCode.BAD_INPUT
) -> DoraSystemdError:
    return DoraSystemdError(f"cannot use {shown(file)} as credential {name}: {reason}", hint, code)
