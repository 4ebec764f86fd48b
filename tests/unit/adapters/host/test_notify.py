"""Messages to the service manager."""

import os

import pytest

from dora_systemd.adapters.host import notify
from tests.unit.fakes.libraries import hear_notifications


def test_a_status_is_one_line_of_utf_8(monkeypatch: pytest.MonkeyPatch) -> None:
    """systemd's library raises for other text, which would end a dataflow for a file's name."""
    told = hear_notifications(monkeypatch)
    name = os.fsdecode(b"a-\xff.py")
    notify.send_status(f"not reloaded: {name}:\n line 3 \u00e9")
    assert told == ["STATUS=not reloaded: a-\\udcff.py: line 3 \u00e9"]
    assert told[0].encode()
