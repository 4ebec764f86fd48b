"""The kernel's own answers, of interfaces that every machine has or lacks."""

import select

from dora_systemd.adapters.host.presence import LinkChanges, Presence, look_at_link


def test_loopback_is_there_and_stays_the_same() -> None:
    found = look_at_link("lo")
    assert found == look_at_link("lo")
    assert found.reason in ("", "down")
    assert (found.identity is None) == bool(found.reason)


def test_an_interface_that_no_machine_has() -> None:
    assert look_at_link("no-such-bus0") == Presence("not there")


def test_without_changes_there_is_nothing_to_read() -> None:
    changes = LinkChanges()
    try:
        changes.drain()
        assert select.select([changes.fd], [], [], 0)[0] == []
    finally:
        changes.close()
