"""The last pictures of a dataflow, for the status page: the body of the answer to /pictures/UUID.

It is one line of JSON, a list with an object for each picture, and then their bytes in the same
order. So time and origin are always those of the bytes, and only the page takes it for pictures.
"""

import json
import threading

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.page_messages import shown_values
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.gateway.live.past import find_subject
from dora_systemd.scope import Scope
from dora_systemd.verbs.bundles.pictures import LastPicture, read_pictures

_TYPES = {"jpg": "image/jpeg", "png": "image/png"}
_TURN = threading.Lock()
"""Pictures need much memory: one answer is made at a time."""


def pictures_body(scope: Scope, uuid: str) -> bytes:
    """The last pictures of a dataflow, none if nobody knows it. Raises DoraSystemdError."""
    manager = Bus(scope, for_reading=True)
    try:
        name, cell = find_subject(manager, scope, uuid)
    except DoraSystemdError as error:
        if error.code is not ExitCode.NOT_FOUND:
            raise
        return format_pictures([])
    with _TURN:
        return format_pictures(read_pictures(manager, scope, name, cell, uuid))


def format_pictures(pictures: list[LastPicture]) -> bytes:
    """The body. bundle: null for the memory of the recorder. type: the media type of the bytes."""
    heads = [
        {
            "output": one.output,
            "at_us": one.at_us,
            "bundle": one.bundle or None,
            "type": _TYPES[one.ending],
            "size_bytes": len(one.data),
        }
        for one in pictures
    ]
    line = f"{json.dumps(shown_values(heads))}\n".encode()
    return b"".join((line, *(one.data for one in pictures)))
