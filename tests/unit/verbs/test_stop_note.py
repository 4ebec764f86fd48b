"""Who asked: the record that `doractl stop` leaves."""

import os
import pwd
import socket
from pathlib import Path

from dora_systemd.adapters.journal.note import send_note
from dora_systemd.verbs.stop_note import caller


def test_names() -> None:
    own = os.getuid()
    assert caller(own, {}) == pwd.getpwuid(own).pw_name
    assert caller(0, {"SUDO_USER": "alice"}) == "root, by sudo of alice"
    assert caller(0, {"SUDO_USER": "root"}) == "root"
    assert caller(2**31, {}) == f"the user {2**31}"


def test_one_datagram_and_nobody_to_take_it(tmp_path: Path) -> None:
    path = str(tmp_path / "socket")
    send_note(b"MESSAGE=lost\n", path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(path)
        send_note(b"MESSAGE=x\n", path)
        assert journald.recv(100) == b"MESSAGE=x\n"
