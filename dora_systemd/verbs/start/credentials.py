"""Checks the files of credentials before systemd reads them."""

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from dora_systemd.adapters.host.files import absolute_path
from dora_systemd.decisions.settings.credentials import CREDENTIALS, MAX_SIZE
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import reached
from dora_systemd.values import shown


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
