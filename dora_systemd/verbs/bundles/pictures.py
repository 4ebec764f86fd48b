"""The last picture of each camera: in the memory of the recorder, or else in the newest bundle.

Nothing here decodes a picture, because the nodes' user can have written any bytes, and in system
scope this process is root. A jpeg or png is passed on as it is.
"""

from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from functools import partial
from itertools import islice
from typing import NamedTuple

from dora_systemd.adapters.bundles.reader import opened
from dora_systemd.adapters.bundles.store import Stored
from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.recorder.mcap import ENCODING, META
from dora_systemd.decisions.recorder.mcap_reader import McapReader
from dora_systemd.decisions.recorder.pictures import is_picture, picture_of, pixels_of
from dora_systemd.decisions.recorder.reading import Reading, Recorded
from dora_systemd.decisions.recorder.ring import RecordHead
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.rings import RingFile
from dora_systemd.verbs.bundles import recording
from dora_systemd.verbs.bundles.listing import store_of
from dora_systemd.verbs.facts.cells import Cell

MOST_BYTES = 32 * 1024 * 1024
"""Maximum bytes of a message, and of all pictures together."""
MOST_CAMERAS = 8
_MOST_PIXELS = 32 * 1024 * 1024
_MOST_MESSAGES = 20_000
"""Maximum messages of a camera that are in memory: finding the last one takes 0.1 s then."""
_MOST_BUNDLES = 5

_Messages = Iterator[tuple[str, Recorded]]
"""The last message of each camera, with its output."""


class LastPicture(NamedTuple):
    """The last picture of a camera."""

    output: str  # NODE/OUTPUT
    at_us: int  # when the recorder received it, CLOCK_REALTIME
    bundle: str  # the bundle that has it, "" for the memory of the recorder
    ending: str  # of a file: jpg or png
    data: bytes


def read_pictures(
    manager: Manager, scope: Scope, name: str, cell: Cell | None, uuid: str
) -> list[LastPicture]:
    """The last pictures of a dataflow. Raises DoraSystemdError (NO_PERMISSION).

    cell: None if systemd has unloaded the dataflow.
    """
    ring = recording.find(manager, scope, cell, uuid)
    if ring is not None and (found := _of_ring(ring)):
        return found
    newest = islice(reversed(store_of(scope, name).known()), _MOST_BUNDLES)
    return next(filter(None, (_of_bundle(one, uuid) for one in newest)), [])


def _of_ring(ring: RingFile) -> list[LastPicture]:
    # ValueError: the user of the nodes has written to the ring.
    with closing(ring), suppress(ValueError):
        records = _MOST_MESSAGES * MOST_CAMERAS  # of all outputs: any of them may be damaged
        return _pictures(_in_ring(Reading(ring, ring.size, MOST_BYTES, records)), "")
    return []


def _in_ring(reading: Reading) -> _Messages:
    for at, output in enumerate(reading.header.outputs):
        if is_picture(reading.metadata(at)) and (one := reading.newest(at, _MOST_MESSAGES)):
            yield output, one


def _of_bundle(one: Stored, uuid: str) -> list[LastPicture]:
    # A bundle that was cut has none.
    with suppress(DoraSystemdError, ValueError, OSError), opened(one.path) as bundle:
        if bundle.manifest.uuid == uuid and (size := bundle.size_of(recording.RECORDING)):
            read = partial(bundle.read_at, recording.RECORDING)
            return _pictures(_in_file(McapReader(read, size, MOST_BYTES)), one.id)
    return []


def _in_file(file: McapReader) -> _Messages:
    for topic in file.topics(ENCODING):
        metadata = file.last(topic + META)
        if metadata is None or not is_picture(metadata.data):
            continue
        one = file.last(topic)
        if one is not None and one.sequence == metadata.sequence:
            sizes = len(one.schema), len(metadata.data), len(one.data)
            head = RecordHead(sum(sizes), one.sequence, one.log_ns, 0, 0, *sizes)
            yield topic, Recorded(0, head, one.schema, metadata.data, one.data)


def _pictures(found: Iterable[tuple[str, Recorded]], bundle: str) -> list[LastPicture]:
    """The pictures among messages, of MOST_BYTES together."""
    pictures, left = [], MOST_BYTES
    for output, message in islice(found, MOST_CAMERAS):
        ending, data = picture_of(message) or ("", b"")
        if len(data) <= left and 0 < pixels_of(ending, data) <= _MOST_PIXELS:
            left -= len(data)
            at_us = message.head.received_ns // 1000
            pictures.append(LastPicture(output, at_us, bundle, ending, data))
    return pictures
