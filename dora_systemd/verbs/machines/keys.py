"""The keys of machines: files beside the settings, one for each machine."""

import os
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.host.files import decoded
from dora_systemd.adapters.host.process import run_command
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import exists
from dora_systemd.trust.programs import own_account

_SECONDS = 30.0


def make_key(place: Path, machine: str) -> Path:
    """The key of a machine, which is there then. Raises DoraSystemdError."""
    path = place / machine
    if exists(path):
        return path
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        code = ExitCode.NO_PERMISSION if isinstance(error, PermissionError) else ExitCode.FAILURE
        raise DoraSystemdError(f"cannot create {place}: {error.strerror}", "", code) from error
    words = ("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", f"dora-systemd {machine}")
    done = run_command((*words, "-f", str(path)), _SECONDS, os.environ, None, own_account())
    if done.status:
        words_of_it = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise DoraSystemdError(f"cannot make the key {path}: {''.join(words_of_it)}")
    return path


def public_key(path: Path) -> str:
    """The public part of a key."""
    public = path.with_name(f"{path.name}.pub")
    return decoded(read_file(public).data, public).strip()


def remove_key(path: Path) -> None:
    """Remove both parts of a key."""
    for one in (path, path.with_name(f"{path.name}.pub")):
        with suppress(FileNotFoundError):
            one.unlink()
