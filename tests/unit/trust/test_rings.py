"""The ring of a dataflow among the files of systemd: nobody's else."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dora_systemd.decisions.recorder.reading import Reading
from dora_systemd.decisions.recorder.ring import Header, format_header, size_of, span_of
from dora_systemd.trust.rings import find_ring

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
