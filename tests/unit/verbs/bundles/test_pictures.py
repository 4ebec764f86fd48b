"""The last pictures of a dataflow: of its ring, or of its bundles."""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.bundles.store import Archive, Section
from dora_systemd.decisions.bundles.manifest import MANIFEST, README, Manifest, format_manifest
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.decisions.recorder.ring import ALIGN, parse_header, state_at, tape_at
from dora_systemd.decisions.recorder.writer import Writer
from dora_systemd.gateway.live.pictures import format_pictures, pictures_body
from dora_systemd.runner.recorder.keep import fitted_ring, header_of
from dora_systemd.runner.recorder.record import FileStore
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import find_ring
from dora_systemd.verbs.bundles import recording
from dora_systemd.verbs.bundles.pictures import MOST_CAMERAS, LastPicture, read_pictures
from dora_systemd.verbs.facts.cells import read_cell
from tests.unit.decisions.recorder.test_pictures import BATCH, BODY, SCHEMA
from tests.unit.fakes.cgroups import fake_cgroups
from tests.unit.fakes.journal import FakeJournal
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options
from tests.unit.fakes.recorder.ring import PAGE, message

IMAGE = {"encoding": "rgb8", "width": 4, "height": 2}
JPEG = bytes.fromhex("ffd8ffe00004abcdffc0001108000400040301") + bytes(5)
NOW_US = 1_790_000_000_000_000


class Bench:
    """The dataflow robot, with a recorder if record() was called."""

    def __init__(self, root: Path, patch: pytest.MonkeyPatch, manager: FakeManager) -> None:
        fake_cgroups(patch, root)
        self.manager, self.patch, self.fds = manager, patch, list[int]()
        self.scope: Scope = ScopeIn(is_user=True, uid=os.getuid(), root=root)
        manager.add(options(), MainPID=os.getpid(), User="")

    def record(self, *messages: tuple[int, Mapping[str, Any], bytes], outputs: int = 2) -> None:
        """Messages of outputs: number of the output, metadata and a batch of 24 bytes."""
        names = [f"camera/out{at}" for at in range(outputs)]
        fd = fitted_ring(-1, header_of(Record(), names, {"uuid": UUID}))
        self.fds.append(fd)
        writer = Writer(FileStore(fd, ALIGN), PAGE)
        for number, (at, metadata, data) in enumerate(messages):
            one = message(data, number, SCHEMA)
            now = NOW_US * 1000 + number
            meta = json.dumps(metadata).encode()
            writer.put(at, one._replace(meta=meta, received_ns=now))

    def stop(self) -> None:
        """systemd lets go of the ring."""
        while self.fds:
            os.close(self.fds.pop())

    def bundle(self, stamp: str, uuid: str = UUID, has_recording: bool = True) -> str:
        """A bundle with the recording as it is now."""
        place = self.scope.state_root / "dora-systemd/bundles/robot"
        place.mkdir(parents=True, exist_ok=True)
        path = place / f"robot-{stamp}-requested.tar"
        manifest = Manifest("robot", uuid, "dora-robot.service", "user", "host", 1, "test")
        with Archive(path, 1 << 24, 1) as archive:
            archive.add(Section(README, lambda sink: sink.write(b"why")))
            ring = find_ring([os.getpid()], UUID, os.getuid()) if has_recording else None
            for one in recording.sections(ring, [], want_pictures=False):
                archive.add(one)
            text = format_manifest(manifest).encode()
            archive.add(Section(MANIFEST, lambda sink: sink.write(text)))
        return path.name

    def read(self) -> list[LastPicture]:
        cell = read_cell(self.manager, "dora-robot.service")
        return read_pictures(self.manager, self.scope, "robot", cell, UUID)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, manager: FakeManager) -> Iterator[Bench]:
    bench = Bench(tmp_path, monkeypatch, manager)
    yield bench
    bench.stop()


def of(data: bytes) -> bytes:
    return BATCH.replace(BODY, data)


def test_the_last_picture_of_each_camera_in_the_ring(bench: Bench) -> None:
    bench.record((0, IMAGE, BATCH), (1, {"encoding": "jpeg"}, of(JPEG)), (0, IMAGE, of(BODY[::-1])))
    png, jpg = bench.read()
    assert (png.output, png.at_us, png.bundle, png.ending) == ("camera/out0", NOW_US, "", "png")
    assert jpg == LastPicture("camera/out1", NOW_US, "", "jpg", JPEG)
    assert png.data.startswith(b"\x89PNG")


def test_without_a_ring_the_newest_bundle_with_a_picture_has_them(bench: Bench) -> None:
    assert bench.read() == []
    bench.record((1, {"encoding": "jpeg"}, of(JPEG)), (0, {}, BATCH))
    bench.bundle("20261127T041500Z")
    name = bench.bundle("20261127T041501Z")
    assert [one.bundle for one in bench.read()] == [""], "the ring is newer than any bundle"
    bench.stop()
    bench.bundle("20261127T041502Z", has_recording=False)
    bench.record((1, {"encoding": "jpeg"}, of(JPEG)))
    bench.bundle("20261127T041503Z", uuid="22222222-2222-4333-8444-555555555555")
    bench.stop()
    assert bench.read() == [LastPicture("camera/out1", NOW_US, name, "jpg", JPEG)]


def test_a_bundle_that_was_cut_has_none(bench: Bench) -> None:
    bench.record((0, IMAGE, BATCH))
    name = bench.bundle("20261127T041500Z")
    bench.stop()
    assert len(bench.read()) == 1
    os.truncate(bench.scope.state_root / "dora-systemd/bundles/robot" / name, 3000)
    assert bench.read() == []


@pytest.mark.parametrize(
    ("metadata", "data"),
    [
        ({}, BATCH),
        ({"encoding": "jpeg"}, BATCH),
        ({**IMAGE, "width": 5}, BATCH),
        # Of a few bytes, with four thousand million pixels.
        ({"encoding": "jpeg"}, of(JPEG.replace(b"\0\4\0\4", b"\xff\xff\xff\xff"))),
    ],
)
def test_what_is_no_picture(bench: Bench, metadata: dict[str, Any], data: bytes) -> None:
    bench.record((0, metadata, data))
    assert bench.read() == []


def test_a_ring_that_the_nodes_have_damaged(bench: Bench) -> None:
    bench.record((0, IMAGE, BATCH))
    (fd,) = bench.fds
    begins = 0, state_at(0), tape_at(parse_header(os.pread(fd, ALIGN, 0)), 0)
    for at in (one for begin in begins for one in range(begin, begin + 400, 4)):
        data = os.pread(fd, 4, at)
        os.pwrite(fd, b"\xff\xff\xff\xff", at)
        assert len(bench.read()) <= 1
        os.pwrite(fd, data, at)
    assert len(bench.read()) == 1


def test_of_many_cameras_only_some_are_shown(bench: Bench) -> None:
    bench.record(*((at, IMAGE, BATCH) for at in range(20)), outputs=20)
    assert [one.output for one in bench.read()] == [f"camera/out{at}" for at in range(MOST_CAMERAS)]


def test_the_answer_for_the_page(bench: Bench) -> None:
    fake_systemd(bench.patch, bench.manager)
    FakeJournal(bench.patch, bench.scope.state_root)
    bench.record((0, IMAGE, BATCH), (1, {"encoding": "jpeg"}, of(JPEG)))
    line, _, rest = pictures_body(bench.scope, UUID).partition(b"\n")
    png, jpeg = json.loads(line)
    assert rest[png["size_bytes"] :] == JPEG
    assert rest.startswith(b"\x89PNG")
    assert jpeg == {
        "output": "camera/out1",
        "at_us": NOW_US,
        "bundle": None,
        "type": "image/jpeg",
        "size_bytes": len(JPEG),
    }
    assert pictures_body(bench.scope, "22222222-2222-4333-8444-555555555555") == b"[]\n"


def test_names_of_outputs_are_one_line_of_text() -> None:
    hostile = LastPicture("a/\x1b[31m\n\0b", 1, "", "png", b"x")
    line, end, data = format_pictures([hostile]).partition(b"\n")
    assert (json.loads(line)[0]["output"], end, data) == ("a/\n\\x00b", b"\n", b"x")
