"""Processes and listeners, from this machine's own /proc and from one of a few files."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dora_systemd.adapters.host.process_table import (
    group_in,
    read_processes,
    socket_owners,
)
from dora_systemd.trust.sockets import listening_sockets


def test_ourselves() -> None:
    (own,) = [one for one in read_processes() if one.pid == os.getpid()]
    assert own.parent == os.getppid()
    assert Path(own.command[0]).name == Path(sys.executable).name
    assert not own.is_node


def test_a_node_is_known_by_its_environment() -> None:
    env, pipe = {"DORA_NODE_CONFIG": "x"}, subprocess.PIPE
    with subprocess.Popen(["cat"], env=env, stdin=pipe, stdout=pipe) as child:
        assert child.stdin is not None and child.stdout is not None
        # After execve(2) has returned: before, it looks like us, or has no command line.
        child.stdin.write(b"\n")
        child.stdin.flush()
        child.stdout.readline()
        (found,) = [one for one in read_processes() if one.pid == child.pid]
        child.stdin.close()
    assert found.is_node
    assert found.command == ("cat",)


def test_who_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        inodes = listening_sockets(server.getsockname()[1])
        assert len(inodes) == 1
        assert socket_owners(inodes) == {os.getpid()}
    assert socket_owners(inodes) == set()


def test_damaged_entries_are_passed_over(tmp_path: Path) -> None:
    whole = {"cmdline": "a b\0c\0", "stat": "7 (a) b) S 5 7 7", "cgroup": "0::/x\n", "environ": ""}
    entries = {"7": whole, "8": whole | {"stat": ""}, "9": whole | {"cmdline": ""}, "10": {}}
    for pid, files in entries.items():
        (tmp_path / pid).mkdir()
        for name, text in files.items():
            (tmp_path / pid / name).write_text(text)
    (found,) = read_processes(tmp_path)
    assert (found.pid, found.parent, found.command, found.group) == (7, 5, ("a b", "c"), "/x")


@pytest.mark.parametrize(
    ("data", "group"),
    [
        (b"0::/dora.slice/dora-a.service/node-b\n", "/dora.slice/dora-a.service/node-b"),
        (b"12:devices:/x\n0::/y\n", "/y"),
        (b"1:name=systemd:/x\n", ""),
        (b"0::/a/x0::/dora.slice/dora-b.service\n", "/a/x0::/dora.slice/dora-b.service"),
        (b"0::/a\xff\x0bb\n", "/a\ufffd\x0bb"),
        (b"", ""),
    ],
)
def test_no_name_of_a_group_hides_it(data: bytes, group: str) -> None:
    assert group_in(data) == group
