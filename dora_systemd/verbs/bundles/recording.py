"""The last messages of outputs in a bundle, and pictures among them: see decisions/recorder/."""

import os
import pwd
from contextlib import closing
from functools import partial

from dora_systemd.adapters.bundles.store import Section, Sink
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.bundles.manifest import directory_names
from dora_systemd.decisions.recorder.mcap import write_recording
from dora_systemd.decisions.recorder.pictures import Picture, find_pictures
from dora_systemd.decisions.recorder.reading import Reading
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile, find_ring
from dora_systemd.verbs.facts.cells import Cell

RECORDING = "recording.mcap"
_MOST_BYTES = 192 * 1024 * 1024
"""Bytes of messages in which pictures are searched, the newest."""


def find(manager: Manager, scope: Scope, cell: Cell | None, uuid: str) -> RingFile | None:
    """The ring of a dataflow among the files of systemd, or of the runner."""
    if cell is None:
        return None
    unit = manager.read(cell.unit, ["User", "MainPID"])
    uid = os.getuid() if scope.is_user else _uid(unit["User"])
    return find_ring([*_managers(manager, scope), unit["MainPID"]], uuid, uid)


def sections(ring: RingFile | None, left_out: list[str], want_pictures: bool) -> list[Section]:
    """The sections of the recorder. left_out: gets what is not in them."""
    if ring is None:
        left_out.append(f"{RECORDING}: nothing was recorded")
        return []
    pictures = _pictures(ring) if want_pictures else []
    of_outputs = directory_names(ring.header.outputs)
    own = [
        Section(f"images/{of_outputs[one.output]}/{one.name}", partial(_put_picture, one))
        for one in pictures
    ]
    return [Section(RECORDING, partial(_put, ring, left_out)), *own]


def _uid(user: str) -> int:
    try:
        return pwd.getpwnam(user).pw_uid if user else 0
    except KeyError:
        return -1


def _managers(manager: Manager, scope: Scope) -> list[int]:
    """The process of systemd: that of a user is alone in a group of its own."""
    if not scope.is_user:
        return [1]
    return cgroup.pids(cgroup.group_path(manager.control_group()) / "init.scope")


def _put(ring: RingFile, left_out: list[str], sink: Sink) -> None:
    with closing(ring):
        most = _fitting(ring, sink.left)
        written = write_recording(Reading(ring, ring.size, most), sink.write, {})
    if written.is_cut:
        left_out.append(f"{RECORDING}: older messages")
    if written.damaged:
        left_out.append(f"{RECORDING}: {written.damaged} damaged messages")


def _fitting(ring: RingFile, left: int) -> int:
    """Bytes of the newest messages of which the file has at most `left` bytes.

    The file has numbers of each message, and the last message of each output in any case.
    """
    most = left * 3 // 4
    while ring.used > most > 0 and _file_size(ring, most) > left:
        most //= 2
    return most


def _file_size(ring: RingFile, most: int) -> int:
    sizes: list[int] = []
    reading = Reading(ring, ring.size, most)
    write_recording(reading, lambda data: sizes.append(len(data)), {})
    return sum(sizes)


def _pictures(ring: RingFile) -> list[Picture]:
    try:
        reading = Reading(ring, ring.size, _MOST_BYTES)
    except ValueError:  # the user of the nodes has written to it: errors.txt has the reason
        return []
    return list(find_pictures(reading.messages()))


def _put_picture(picture: Picture, sink: Sink) -> None:
    sink.write(picture.data)
