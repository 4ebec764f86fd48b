"""Finds the files of a dataflow with the permissions of the user that it will run as.

Paths from another user's settings are only checked with that user's permissions: root must not
reveal whether a file exists. Paths on root's own command line are also checked as root, which gives
clearer errors.
"""

import pwd
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dora_systemd.adapters.dora.command import find_dora
from dora_systemd.adapters.host.files import decoded, parse_yaml
from dora_systemd.decisions.descriptor.build_session import (
    BuildSession,
    parse_session,
    session_path,
)
from dora_systemd.decisions.settings.kinds import Setting
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.table import DORA, VENV, WORKING_DIRECTORY
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.files import unreadable
from dora_systemd.trust.sight import Sight, cannot_reach
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
