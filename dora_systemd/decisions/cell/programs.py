"""How the kernel executes a program, by its first bytes, and which dora a wheel has. Pure."""

import re
from collections.abc import Iterable

_ELF = b"\x7fELF"
_MACHINES = {3: "i686", 21: "ppc64", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
"""e_machine of elf(5), and the word of uname(1)."""
_ALSO = {"x86_64": ("i686",), "aarch64": ("arm",)}
"""Other machines whose programs the kernel of a machine may execute, too."""
_INFO = re.compile(r"(\d{1,9}(?:\.\d{1,9}){1,3}[0-9A-Za-z.+]{0,20})\.dist-info")
_PYTHON = re.compile(r"python3\.\d{1,3}")


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
    return [one for one in names if _PYTHON.fullmatch(one)]


def wheel_version(names: Iterable[str], wheel: str) -> str:
    """The version of an installed wheel, by the name of its directory; "" if there is none."""
    begin = f"{wheel}-"
    found = (_INFO.fullmatch(one.removeprefix(begin)) for one in names if one.startswith(begin))
    return next((one[1] for one in found if one), "")
