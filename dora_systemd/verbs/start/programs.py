"""Checks before a start that the user of the nodes can execute Python and dora, and their versions.

Virtual environments link to a Python that may be anywhere: below /root, where uv puts it for root,
in another user's home, or on the machine that the project was copied from.
"""

import os
import pwd
import re
import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path, PurePath

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.dora.command import OLDEST_DORA, version_numbers
from dora_systemd.errors import DoraSystemdError, ExitCode, bad_input
from dora_systemd.trust.programs import Account, account_from
from dora_systemd.trust.sight import Sight, sight_of
from dora_systemd.values import shell_word, shown
from dora_systemd.verbs.facts.cells import Cell

_ELF = b"\x7fELF"
_MACHINES = {3: "i686", 21: "ppc64", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
"""e_machine of elf(5), and the word of uname(1)."""
_ALSO = {"x86_64": ("i686",), "aarch64": ("arm",)}
"""Other machines whose programs the kernel of a machine may execute, too."""
_INFO = r"(\d{1,9}(?:\.\d{1,9}){1,3}[0-9A-Za-z.+]{0,20})\.dist-info"
_PYTHON = r"python3\.\d{1,3}"


def elf_machine(head: bytes) -> str:
    """The machine that an ELF program is for; "" for another file, or an unknown machine."""
    if not head.startswith(_ELF) or len(head) < 20:
        return ""
    number = int.from_bytes(head[18:20], "little" if head[5] == 1 else "big")
    return _MACHINES.get(number, "")


def is_for(machine: str, here: str) -> bool:
    """Whether this machine may execute programs of `machine`. here: the word of uname(1)."""
    known = here in _MACHINES.values()
    return not (machine and known) or machine in (here, *_ALSO.get(here, ()))


def script_interpreter(head: bytes) -> str:
    """The interpreter of a script, by its first line; "" for another program."""
    line, newline, _ = head.partition(b"\n")
    words = line[2:].split() if head.startswith(b"#!") and newline else []
    text = words[0].decode(errors="surrogateescape") if words else ""
    return text if text.startswith("/") else ""


def python_directories(names: Iterable[str]) -> list[str]:
    """Return the names that can be the directory of a Python, such as python3.13."""
    return [one for one in names if re.fullmatch(_PYTHON, one)]


def wheel_version(names: Iterable[str], wheel: str) -> str:
    """The version of an installed wheel, by the name of its directory; "" if there is none."""
    begin = f"{wheel}-"
    found = (re.fullmatch(_INFO, one.removeprefix(begin)) for one in names if one.startswith(begin))
    return next((one[1] for one in found if one), "")


_PACKAGE = "/usr/lib/dora-cli/"
"""The directory where the package dora-cli has the metadata of its wheel."""
_BINFMT = Path("/proc/sys/fs/binfmt_misc")
_OWN_FILES = {"register", "status"}


def check_program(
    path: str, sight: Sight, user: pwd.struct_passwd | None, here: str = "", depth: int = 1
) -> None:
    """Raise DoraSystemdError if the user of the nodes cannot execute a program, or its interpreter.

    user: None for the caller. here: the machine, as in uname(1); "" for this one. depth: how many
    interpreters are followed.
    """
    who = "you" if user is None else f"user {user.pw_name}"
    if not sight.is_program(path):
        raise _unusable(path, sight, who)
    with suppress(OSError):  # an executable that is not readable
        head = sight.head(path)
        _check_machine(path, sight.real(path), head, here)
        if depth and (interpreter := script_interpreter(head)):
            check_program(interpreter, sight, user, here, depth - 1)


def _check_machine(path: str, real: str, head: bytes, here: str) -> None:
    machine, this = elf_machine(head), here or os.uname().machine
    if is_for(machine, this) or (not here and _has_emulators()):
        return
    reason = f"{_leads(path, real)} is a program for {machine}, and this machine is {this}"
    raise bad_input(f"cannot use {shown(path)}: {reason}", f"{_again(path)} on this machine")


def _has_emulators() -> bool:
    """Whether the kernel may execute programs of other machines, see binfmt_misc of Linux."""
    try:
        return any(one.name not in _OWN_FILES for one in _BINFMT.iterdir())
    except OSError:
        return False


def _unusable(path: str, sight: Sight, who: str) -> DoraSystemdError:
    """Return the error with the reason why a program cannot be executed."""
    real = sight.real(path)
    leads = _leads(path, real)
    code = ExitCode.NO_PERMISSION
    if sight.exists(real):
        reason, hint = f"{who} cannot execute {leads}", f"chmod a+x {shell_word(real)}"
    elif _is_gone(real, sight):
        reason, code = f"{leads} does not exist", ExitCode.BAD_INPUT
        hint = _again(path)
    else:
        reason = f"{leads} is behind {shown(_barrier(real, sight))}, which {who} cannot enter"
        hint = f"{_again(path)} with a Python that all can execute, such as /usr/bin/python3; "
        hint += "uv puts its own where UV_PYTHON_INSTALL_DIR says, such as /opt/uv/python"
    return DoraSystemdError(f"cannot use {shown(path)}: {reason}", hint, code)


def _leads(path: str, real: str) -> str:
    """Name the program that a path leads to, in a sentence about that path."""
    return "it" if path == real else f"the program that it leads to, {shown(real)},"


def _again(path: str) -> str:
    """Format how to create a virtual environment again. path: of a program in it."""
    place = PurePath(path).parent
    if place.name != "bin":
        return "install it"
    return f"remove {shown(str(place.parent))} and make it again, by uv sync or python3 -m venv,"


def _is_gone(path: str, sight: Sight) -> bool:
    try:
        sight.head(path)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return False


def _barrier(path: str, sight: Sight) -> str:
    """The last directory on the way to `path` that the account sees; it cannot enter that one."""
    parents = (str(one) for one in PurePath(path).parents)
    return next((one for one in parents if sight.exists(one)), "/")


_IMPORTED = ("dora_systemd", "click", "websockets", "yaml")
"""The packages of Python without which neither doractl nor a runner starts."""


def unreadable_file(account: Account) -> str:
    """The first file of this installation that an account cannot read; "" if it can read all."""
    specs = (find_spec(one) for one in _IMPORTED)
    files = [one.origin for one in specs if one and one.origin]
    try:
        with sight_of(account) as sight:
            return first_unreadable(files, sight)
    except DoraSystemdError:
        return sys.executable


def first_unreadable(files: Iterable[str], sight: Sight) -> str:
    """The first of the files that an account cannot read, or ""."""
    for one in files:
        try:
            sight.head(one)
        except OSError:
            return one
    return ""


def daemon_dora(dora: str, sight: Sight) -> str:
    """The version of a dora command, without running it, or ""."""
    places = (str(PurePath(one).parent.parent) for one in (dora, sight.real(dora)))
    found = (_wheel(one, "dora_rs_cli", sight) for one in places)
    own = "dora_rs_cli"
    package = wheel_version(sight.names(_PACKAGE + own), own) if dora == "/usr/bin/dora" else ""
    return next(filter(None, found), package)


def _wheel(prefix: str, wheel: str, sight: Sight) -> str:
    for one in python_directories(sight.names(f"{prefix}/lib/python3.")):
        names = sight.names(f"{prefix}/lib/{one}/site-packages/{wheel}-")
        if version := wheel_version(names, wheel):
            return version
    return ""


def version_trouble_of(manager: Manager, cell: Cell) -> tuple[str, str]:
    """Return what version_trouble() returns for a loaded dataflow, as the user of its nodes.

    Raises DoraSystemdError as that does, and if that user was deleted.
    """
    if not cell.options.venv:
        return "", ""
    user = manager.read(cell.unit, ["User"])["User"]
    try:
        account = account_from(pwd.getpwnam(user)) if user else None
    except KeyError as error:
        message = f"cannot look at {cell.options.venv} as user {user}: there is none any more"
        raise DoraSystemdError(message, "create that user again") from error
    with sight_of(account) as sight:
        return version_trouble(cell.options.venv, cell.options.dora, sight)


def version_warnings(manager: Manager, cells: Iterable[Cell]) -> Iterator[str]:
    """Warn of dataflows that run, and whose nodes have another dora than their daemon."""
    for cell in cells:
        # A version that no daemon takes is an error of the start, or of the node.
        with suppress(DoraSystemdError):
            text, remedy = version_trouble_of(manager, cell)
            if text:
                yield f"{cell.name}: {text}: {remedy}"


def version_trouble(venv: str | None, dora: str, sight: Sight) -> tuple[str, str]:
    """Compare the dora of Python nodes with that of the daemon: what differs, and a remedy, or "".

    The remedy runs a program of the user of the nodes, which must not run as root. venv: of the
    nodes. Raises DoraSystemdError (BAD_INPUT) for a dora that no daemon takes.
    """
    version = _wheel(venv, "dora_rs", sight) if venv else ""
    if not version or not venv:
        return "", ""
    has_pip = sight.exists(f"{venv}/bin/pip")  # uv's have none
    place = shlex.quote(shown(venv))
    install = f"{place}/bin/pip install" if has_pip else f"uv pip install --python {place}"
    install = f"as {sight.user}: {install}" if sight.user else install
    if version_numbers(version) < OLDEST_DORA:
        message = f"cannot start nodes with the Python of {shown(venv)}: their dora is "
        message += f"{version}, 1.0 or newer is needed"
        raise bad_input(message, f"{install} --upgrade dora-rs")
    daemon = daemon_dora(dora, sight)
    if daemon in ("", version):
        return "", ""
    text = f"the nodes' dora is {version}, the daemon is {daemon}"
    return text, f"{install} dora-rs=={daemon}"
