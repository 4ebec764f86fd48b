"""The dora command: find it, run it once, read its version."""

import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dora_systemd.adapters.host.process import Completed, run_command
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import Account, fresh_environment, own_account
from dora_systemd.trust.sight import Sight

OLDEST_DORA = (1, 0)
"""Before 1.0 the control protocol was another one."""
RECOMMENDED_DORA = (1, 1)

DORA_SECONDS = 60.0

_PRINT_VERSION = "import sys; print('%d.%d.%d' % sys.version_info[:3])"
INSTALL_HINT = "pip install dora-rs-cli, install the package dora-cli, or give --dora PATH"


def run_dora(
    dora: str,
    arguments: Sequence[str],
    account: Account | None,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
) -> Completed:
    """Run a dora command that ends by itself, such as `dora validate`, without colours.

    account: whose dora it is; None: as root only a dora that is root's.
    """
    own = os.environ if account is None else fresh_environment(account)
    surroundings = {**(own if environment is None else environment)}
    surroundings |= {"RUST_BACKTRACE": "0", "NO_COLOR": "1"}
    return run_command((dora, *arguments), DORA_SECONDS, surroundings, directory, account)


def refusal_reason(done: Completed) -> str:
    """Return why a dora command has failed, in one line."""
    return parse_dora_error(done.stderr) or parse_dora_error(done.stdout) or "dora refuses it"


def find_dora(
    given: str | None, venv: str | None, search_path: str, sight: Sight | None = None
) -> str:
    """Absolute path of the dora command: the one given, else of the venv, else on `search_path`.

    The last candidate is next to our own Python: pip may have installed both into one virtual
    environment, with a link on PATH only to doractl. sight: of the account that must see the
    command. Raises DoraSystemdError (NO_DORA).
    """
    places = search_path.split(os.pathsep)
    if given is None:
        places = [*([f"{venv}/bin"] if venv else []), *places, str(Path(sys.executable).parent)]
    found = _which("dora" if given is None else given, places, sight or Sight())
    if found is None:
        what = "find the dora command" if given is None else f"run the dora command {given}"
        raise DoraSystemdError(f"cannot {what}", INSTALL_HINT, ExitCode.NO_DORA)
    return found


def _which(name: str, places: Sequence[str], sight: Sight) -> str | None:
    paths = [name] if "/" in name else [f"{place}/{name}" for place in places if place]
    return next(filter(sight.is_program, (str(Path(one).absolute()) for one in paths)), None)


def dora_version(
    dora: str, account: Account | None = None, environment: Mapping[str, str] | None = None
) -> str:
    """The version of a dora command, as in "1.1.0". account, environment: as for run_dora.

    Raises DoraSystemdError (NO_DORA) if it is none, or older than OLDEST_DORA.
    """
    try:
        done = run_dora(dora, ["--version"], account, environment)
    except DoraSystemdError as error:
        # Such as a script of an environment that was moved: its Python is gone.
        if not isinstance(error.__cause__, OSError):
            raise
        raise DoraSystemdError(error.message, INSTALL_HINT, ExitCode.NO_DORA) from error
    version = parse_dora_version(done.stdout) if done.status == 0 else None
    if version is None:
        words = " ".join((done.stderr or done.stdout).split())[:200]
        raise DoraSystemdError(
            f"cannot use {dora} as dora command: {words or 'it tells no version'}",
            INSTALL_HINT,
            ExitCode.NO_DORA,
        )
    if version_numbers(version) < OLDEST_DORA:
        raise DoraSystemdError(
            f"cannot use {dora}: it is dora {version}, 1.0 or newer is needed",
            "pip install --upgrade dora-rs-cli",
            ExitCode.NO_DORA,
        )
    return version


def python_version(python: str, environment: Mapping[str, str]) -> str:
    """The version of an interpreter, as in "3.13.5", "" if it is none. Blocks for some 10 ms.

    This runs inside the cell, so as its user, and never as root for another user.
    """
    try:
        command = (python, "-I", "-S", "-c", _PRINT_VERSION)
        done = run_command(command, DORA_SECONDS, environment, None, own_account())
    except DoraSystemdError:
        return ""
    return done.stdout.strip() if done.status == 0 else ""


def parse_dora_version(text: str) -> str | None:
    """The version in "dora-cli 1.1.0", or None."""
    # Bounded: the program may be another user's.
    match = re.match(r"dora(?:-cli)?\s+(\d{1,9}\.\d{1,9}\S{,40})(?!\S)", text)
    return match[1] if match else None


def version_numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version: (1, 1, 0) for "1.1.0-rc.1"."""
    match = re.match(r"\d{1,9}(\.\d{1,9})*", version)
    return tuple(map(int, match[0].split("."))) if match else ()
