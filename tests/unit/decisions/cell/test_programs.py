"""How programs are executed, by their first bytes."""

import platform
import sys
from pathlib import Path

import pytest

from dora_systemd.decisions.cell.programs import (
    elf_machine,
    is_for,
    python_directories,
    script_interpreter,
    wheel_version,
)


def elf(machine: int, order: str = "little") -> bytes:
    """The beginning of an ELF program."""
    ident = b"\x7fELF\x02" + (b"\x01" if order == "little" else b"\x02")
    return ident.ljust(18, b"\0") + machine.to_bytes(2, "little" if order == "little" else "big")


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
