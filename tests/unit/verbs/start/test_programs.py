"""Pythons and doras that the user of the nodes cannot execute, and those of another version."""

import errno
import os
import platform
import pwd
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import pytest

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import own_account
from dora_systemd.trust.sight import Sight
from dora_systemd.verbs.start.programs import (
    check_program,
    daemon_dora,
    elf_machine,
    first_unreadable,
    is_for,
    python_directories,
    script_interpreter,
    unreadable_file,
    version_trouble,
    wheel_version,
)
from tests.unit.fakes.programs import make_program


def elf(machine: int, order: str = "little") -> bytes:
    """The beginning of an ELF program."""
    ident = b"\x7fELF\x02" + (b"\x01" if order == "little" else b"\x02")
    return ident.ljust(18, b"\0") + machine.to_bytes(2, "little" if order == "little" else "big")


ALICE: Any = pwd.struct_passwd(("alice", "x", 1000, 1000, "", "/home/alice", "/bin/sh"))
PYTHON = elf(62)
VENV = "/srv/x/.venv/bin/python"


@dataclass
class Disk(Sight):
    """What an account sees. links: targets by path. closed: directories that it cannot enter."""

    files: Mapping[str, bytes] = field(default_factory=dict)
    links: Mapping[str, str] = field(default_factory=dict)
    closed: tuple[str, ...] = ()

    def _ask(self, letter: bytes, path: str) -> bytes:
        for _ in range(9):
            path = self.links.get(path, path)
        if letter == b"l":
            return os.fsencode(path)
        if {*map(str, PurePath(path).parents)} & {*self.closed}:
            raise OSError(errno.EACCES, "")
        directories = {str(one) for file in self.files for one in PurePath(file).parents}
        if path not in (*self.files, *directories, *self.closed):
            raise OSError(errno.ENOENT, "")
        return self.files.get(path, b"") if letter == b"h" else b"1"


@dataclass
class Layout:
    """A Python of nodes. message, hint: of the refusal, if it is refused."""

    disk: Disk
    message: str = ""
    hint: str = ""
    python: str = VENV


REAL = "/usr/bin/python3.13"
CONDA = "/opt/conda/envs/x/bin/python"
LAYOUTS = {
    "the system's Python": Layout(Disk({REAL: PYTHON}), python=REAL),
    "a .venv beside the file": Layout(Disk({REAL: PYTHON}, {VENV: REAL})),
    "uv's Python below /root": Layout(
        Disk({}, {VENV: "/root/.local/share/uv/python/3.13/bin/python3.13"}, ("/root",)),
        f"cannot use {VENV}: the program that it leads to, /root/.local/share/uv/python/3.13/bin/"
        "python3.13, is behind /root, which user alice cannot enter",
        "UV_PYTHON_INSTALL_DIR says, such as /opt/uv/python",
    ),
    "a Python in another user's home": Layout(
        Disk({}, {VENV: "/home/bob/py/bin/python3"}, ("/home/bob",)),
        "is behind /home/bob, which user alice cannot enter",
        "with a Python that all can execute",
    ),
    "pyenv in the own home": Layout(
        Disk(
            {"/home/alice/.pyenv/versions/3.13/bin/python3": PYTHON},
            {VENV: REAL, REAL: ("/home/alice/.pyenv/versions/3.13/bin/python3")},
        ),
    ),
    "a shim of pyenv": Layout(
        Disk({"/home/alice/.pyenv/shims/python": b"#!/bin/bash\n", "/bin/bash": PYTHON}),
        python="/home/alice/.pyenv/shims/python",
    ),
    "conda": Layout(Disk({CONDA: PYTHON}), python=CONDA),
    "a base that was removed": Layout(
        Disk({"/srv/x/.venv/pyvenv.cfg": b""}, {VENV: "/opt/old/bin/python3.11"}),
        f"cannot use {VENV}: the program that it leads to, /opt/old/bin/python3.11, does not exist",
        "remove /srv/x/.venv and make it again",
    ),
    "another machine's": Layout(
        Disk({REAL: elf(183)}, {VENV: REAL}),
        "/usr/bin/python3.13, is a program for aarch64, and this machine is x86_64",
        "make it again, by uv sync or python3 -m venv, on this machine",
    ),
    "a script whose interpreter is gone": Layout(
        Disk({"/srv/x/.venv/bin/dora": b"#!/srv/x/.venv/bin/python\n"}, {VENV: "/opt/old/python"}),
        "/opt/old/python, does not exist",
        python="/srv/x/.venv/bin/dora",
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_interpreters(name: str) -> None:
    layout = LAYOUTS[name]
    if not layout.message:
        check_program(layout.python, layout.disk, ALICE, "x86_64")
        return
    with pytest.raises(DoraSystemdError) as caught:
        check_program(layout.python, layout.disk, ALICE, "x86_64")
    assert layout.message in caught.value.message
    assert layout.hint in caught.value.hint


def test_a_program_without_the_permission(tmp_path: Path) -> None:
    """As the caller, with real files."""
    path = tmp_path / "python"
    make_program(path)
    check_program(str(path), Sight(), None)
    path.chmod(0o644)
    with pytest.raises(DoraSystemdError, match=f"cannot use {path}: you cannot execute it$"):
        check_program(str(path), Sight(), None)


def test_a_program_whose_name_is_a_command(tmp_path: Path) -> None:
    """Root may paste the hint into a shell."""
    path = tmp_path / "a; id"
    make_program(path)
    path.chmod(0o644)
    with pytest.raises(DoraSystemdError) as caught:
        check_program(str(path), Sight(), None)
    assert caught.value.hint == f"chmod a+x '{path}'"


def install(prefix: Path, wheel: str, version: str, python: str = "python3.13") -> str:
    """A wheel in a prefix, which it returns."""
    (prefix / f"lib/{python}/site-packages/{wheel}-{version}.dist-info").mkdir(parents=True)
    return str(prefix)


class SightOfAlice(Sight):
    user = "alice"


def test_what_root_is_advised_is_no_program_for_root(tmp_path: Path) -> None:
    """Alice chooses the path, and what is there."""
    dora = install(tmp_path / "dora", "dora_rs_cli", "1.1.0") + "/bin/dora"
    venv = install(tmp_path / "a;b", "dora_rs", "1.0.1")
    make_program(Path(venv) / "bin/pip")
    _, remedy = version_trouble(venv, dora, SightOfAlice())
    assert remedy == f"as alice: '{venv}'/bin/pip install dora-rs==1.1.0"


def test_versions_of_nodes_and_daemon(tmp_path: Path) -> None:
    venv, other = install(tmp_path / "v", "dora_rs", "1.0.1"), tmp_path / "dora"
    install(other, "dora_rs_cli", "1.1.0", "python3.11")
    dora, sight = f"{other}/bin/dora", Sight()
    text, remedy = version_trouble(venv, dora, sight)
    assert text == "the nodes' dora is 1.0.1, the daemon is 1.1.0"
    assert remedy == f"uv pip install --python {venv} dora-rs==1.1.0"
    make_program(Path(venv) / "bin/pip")
    assert version_trouble(venv, dora, sight)[1] == f"{venv}/bin/pip install dora-rs==1.1.0"
    for nothing in (
        version_trouble(None, dora, sight),
        version_trouble(venv, str(tmp_path / "nowhere/dora"), sight),
        version_trouble(install(tmp_path / "w", "dora_rs", "1.1.0"), dora, sight),
    ):
        assert nothing == ("", "")


def test_nodes_that_no_daemon_takes(tmp_path: Path) -> None:
    """dora 0.5 cannot read the configuration that a daemon of dora 1 gives its nodes."""
    venv = install(tmp_path, "dora_rs", "0.5.0")
    with pytest.raises(DoraSystemdError, match=r"their dora is 0\.5\.0, 1\.0 or newer") as caught:
        version_trouble(venv, "/nowhere/dora", Sight())
    assert caught.value.code is ExitCode.BAD_INPUT


def test_a_dora_behind_a_link(tmp_path: Path) -> None:
    install(tmp_path / "tool", "dora_rs_cli", "1.1.0")
    make_program(tmp_path / "tool/bin/dora")
    (tmp_path / "dora").symlink_to("tool/bin/dora")
    assert daemon_dora(str(tmp_path / "dora"), Sight()) == "1.1.0"


def test_the_machine_of_a_program() -> None:
    assert elf_machine(elf(62)) == "x86_64"
    assert elf_machine(elf(183)) == "aarch64"
    assert elf_machine(elf(21, "big")) == "ppc64"
    for head in (b"", b"#!/bin/sh\n", elf(62)[:19], elf(9999)):
        assert elf_machine(head) == ""
    own = Path(sys.executable).resolve().read_bytes()[:64]
    assert elf_machine(own) in ("", platform.machine())


@pytest.mark.parametrize(
    ("machine", "here", "expected"),
    [
        ("x86_64", "x86_64", True),
        ("aarch64", "x86_64", False),
        ("i686", "x86_64", True),
        ("arm", "aarch64", True),
        ("aarch64", "arm", False),
        ("", "x86_64", True),
        ("x86_64", "loongarch64", True),  # nothing is known of that one
    ],
)
def test_what_a_machine_executes(machine: str, here: str, expected: bool) -> None:
    assert is_for(machine, here) is expected


def test_the_interpreter_of_a_script() -> None:
    assert script_interpreter(b"#!/usr/bin/python3 -I\nimport sys\n") == "/usr/bin/python3"
    assert script_interpreter(b"#! /bin/sh\n") == "/bin/sh"
    for head in (b"", b"#!\n", b"#!/bin/sh", b"#!python3\n", b"import sys\n"):
        assert script_interpreter(head) == ""


def test_the_version_of_a_wheel() -> None:
    names = ["dora_rs-x.dist-info", "dora_rs-1.0.1.dist-info", "dora_rs_cli-1.1.0.dist-info"]
    assert wheel_version(names, "dora_rs") == "1.0.1"
    assert wheel_version(names, "dora_rs_cli") == "1.1.0"
    assert wheel_version(["dora_rs-1.1.0rc2.dist-info"], "dora_rs") == "1.1.0rc2"
    for bad in ("dora_rs-1.0.dist-info\x1b", "dora_rs-1." + "9" * 99, "dora_rs-1.0.1"):
        assert wheel_version([bad], "dora_rs") == ""
    assert python_directories(["python3.13", "python3.13t", "python3", "x"]) == ["python3.13"]


def test_what_an_account_cannot_read_of_this_installation() -> None:
    files = ("/opt/x/bin/a", "/opt/x/lib/b", "/opt/x/lib/c")
    disk = Disk(dict.fromkeys(files, b""), closed=("/opt/x/lib",))
    assert first_unreadable(files, disk) == "/opt/x/lib/b"
    assert first_unreadable(files[:1], disk) == ""
    assert unreadable_file(own_account()) == ""
