"""The last messages of a dataflow in its bundle."""

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.bundles.manifest import is_part_name
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.decisions.recorder.ring import ALIGN
from dora_systemd.decisions.recorder.writer import Writer
from dora_systemd.runner.recorder.keep import fitted_ring, header_of
from dora_systemd.runner.recorder.record import FileStore
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile, find_ring
from dora_systemd.verbs.bundles import recording
from dora_systemd.verbs.facts.cells import read_cell
from tests.unit.decisions.recorder.test_pictures import BATCH, SCHEMA
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.manager import FakeManager, options
from tests.unit.fakes.recorder.mcap import File
from tests.unit.fakes.recorder.ring import PAGE, message

IMAGE = {"encoding": "rgb8", "width": 4, "height": 2}


class Sink(io.BytesIO):
    """A part of a bundle. most: bytes that it may have."""

    def __init__(self, most: int = 1 << 30) -> None:
        super().__init__()
        self.most = most

    @property
    def left(self) -> int:
        return self.most - self.tell()


@pytest.fixture
def ring() -> Iterator[int]:
    facts = {"uuid": options().uuid}
    fd = fitted_ring(-1, header_of(Record(), ["camera/image"], facts))
    one = message(BATCH, 5, SCHEMA)._replace(meta=json.dumps(IMAGE).encode())
    Writer(FileStore(fd, ALIGN), PAGE).put(0, one)
    yield fd
    os.close(fd)


def found() -> RingFile:
    file = find_ring([os.getpid()], options().uuid, os.getuid())
    assert file is not None
    return file


def written(want_pictures: bool) -> tuple[dict[str, bytes], list[str]]:
    parts, left_out = {}, list[str]()
    for name, write in recording.sections(found(), left_out, want_pictures):
        sink = Sink()
        write(sink)
        parts[name] = sink.getvalue()
    return parts, left_out


def test_the_messages_and_their_pictures(ring: int) -> None:
    del ring
    parts, left_out = written(want_pictures=True)
    assert list(parts) == ["recording.mcap", "images/camera-image/000001.png"]
    assert all(map(is_part_name, parts))
    file = File(parts["recording.mcap"])
    assert [one.topic for one in file.messages] == ["camera/image", "camera/image#metadata"]
    assert parts["images/camera-image/000001.png"].startswith(b"\x89PNG")
    assert left_out == []
    assert list(written(want_pictures=False)[0]) == ["recording.mcap"]


@pytest.mark.parametrize("size", [100, 40_000])
def test_the_newest_messages_that_fit(ring: int, size: int) -> None:
    store = Writer(FileStore(ring, ALIGN), PAGE)
    for number in range(400_000 // size):
        store.put(0, message(number.to_bytes(4, "little") + bytes(size), 6 + number, SCHEMA))
    left_out, sink = list[str](), Sink(200_000)
    (section,) = recording.sections(found(), left_out, want_pictures=False)
    section.write(sink)
    assert 60_000 < len(sink.getvalue()) <= 200_000
    last = File(sink.getvalue()).messages[-1].data[:4]
    assert int.from_bytes(last, "little") == 400_000 // size - 1
    assert left_out == ["recording.mcap: older messages"]


def test_without_a_recorder_it_is_left_out() -> None:
    left_out = list[str]()
    assert recording.sections(None, left_out, True) == []
    assert left_out == ["recording.mcap: nothing was recorded"]


def test_a_ring_that_somebody_has_damaged(ring: int) -> None:
    file = found()
    os.pwrite(ring, b"x" * 100, 0)
    (section,) = recording.sections(file, [], True)
    with pytest.raises(ValueError, match="it is no ring"):
        section.write(Sink())


def test_the_ring_of_the_dataflow_is_found(
    ring: int, manager: FakeManager, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    del ring
    fake_cgroups(monkeypatch, tmp_path)
    manager.add(options(), MainPID=os.getpid(), User="")
    cell = read_cell(manager, "dora-robot.service")
    for is_user in (True, False):
        one = recording.find(manager, Scope(is_user, os.getuid()), cell, options().uuid)
        assert (one is not None) == (is_user or os.getuid() == 0)
        if one is not None:
            one.close()
    assert recording.find(manager, Scope(True, os.getuid()), None, options().uuid) is None
