"""The ring of a dataflow among the files of systemd: nobody's else."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora_systemd.decisions.recorder.reading import Reading
from dora_systemd.decisions.recorder.ring import Header, format_header, size_of, span_of
from dora_systemd.trust.rings import find_ring

NAMED = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)

def call(name, *arguments):
    if getattr(libc, name)(*arguments):
        sys.exit(f"{name}: {os.strerror(ctypes.get_errno())}")

uid, gid = os.getuid(), os.getgid()
call("unshare", 0x10020000)  # CLONE_NEWUSER, CLONE_NEWNS
for name, text in ("setgroups", "deny"), ("uid_map", f"0 {uid} 1"), ("gid_map", f"0 {gid} 1"):
    with open(f"/proc/self/{name}", "w") as file:
        file.write(text)
call("mount", b"none", b"/", None, 0x44000, None)  # MS_REC, MS_PRIVATE
call("mount", b"x", b"/mnt", b"tmpfs", 0, None)
open("/mnt/memfd:dora-ring", "w").close()
call("mount", os.fsencode(sys.argv[1]), b"/mnt/memfd:dora-ring", None, 0x1000, None)  # MS_BIND
kept = os.open("/mnt/memfd:dora-ring", os.O_PATH)
os.mkdir("/mnt/old")
os.chdir("/mnt")
call("syscall", int(sys.argv[2]), b".", b"old")  # pivot_root
call("umount2", b"/old", 2)
print(flush=True)
sys.stdin.read()
"""
"""Has a descriptor of the file argv[1], which /proc shows with the name of a ring."""
LIBC = ctypes.CDLL(None)
PIVOT_ROOT = {"x86_64": "155", "aarch64": "41"}

OWN, OTHER = "550e8400-e29b-41d4-a716-446655440000", "660e8400-e29b-41d4-a716-446655440000"
ME = os.getuid()


@contextmanager
def kept(name: str = "dora-ring", data: bytes = b"", **facts: str) -> Iterator[int]:
    header = Header(["a/b"], span_of(4096), 4096, 1, False, facts)
    fd = os.memfd_create(name)
    os.ftruncate(fd, size_of(header))
    os.pwrite(fd, data or format_header(header), 0)
    try:
        yield fd
    finally:
        os.close(fd)


def test_it_is_found_by_its_uuid() -> None:
    with kept(uuid=OTHER), kept(uuid=OWN) as fd:
        ring = find_ring([1 << 30, os.getpid()], OWN, ME)
        assert ring is not None
        assert ring.header.facts == {"uuid": OWN}
        assert ring.size == os.fstat(fd).st_size
        assert list(Reading(ring, ring.size, 1000).messages()) == []
        ring.close()


def test_what_is_no_ring_of_the_user_is_none() -> None:
    """Everybody can give systemd a file with any name and text to keep."""
    with kept(uuid=OTHER), kept("other", uuid=OWN), kept(data=b"DORARING" * 100), kept():
        assert find_ring([os.getpid()], OWN, ME) is None
    with kept(uuid=OWN):
        assert find_ring([os.getpid()], OWN, ME + 1) is None


def test_a_link_to_something_else(tmp_path: Path) -> None:
    place = tmp_path / "7" / "fd"
    place.mkdir(parents=True)
    (place / "3").symlink_to("/memfd:dora-ring (deleted)")
    (place / "4").write_text("no link")
    assert find_ring([7], OWN, ME, tmp_path) is None


def test_nothing_but_a_regular_file_is_opened(tmp_path: Path) -> None:
    """To open a device can do something, such as start a watchdog that nothing feeds."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    command = [sys.executable, "-c", NAMED, str(pipe), PIVOT_ROOT.get(os.uname().machine, "0")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout
        if not child.stdout.readline():
            pytest.skip("no user namespaces here")
        watch = LIBC.inotify_init1(os.O_NONBLOCK)
        LIBC.inotify_add_watch(watch, os.fsencode(pipe), 0x20)  # IN_OPEN
        assert find_ring([child.pid], OWN, ME) is None
        with os.fdopen(watch, "rb", buffering=0) as opens:
            assert opens.read() is None
