"""What a start waits for, in the words of needs."""

import pytest

from dora_systemd.decisions.needs.awaited import format_awaited


@pytest.mark.parametrize(
    ("units", "text"),
    [
        ((), ""),
        (("network-online.target",), "network"),
        (("time-sync.target", "chrony-wait.service"), "clock"),
        (("dora-base.service", "basic.target", "dora.slice"), "dataflow base"),
        (("basic.target", "dora.slice"), "basic.target, dora.slice"),
        (("data-my\\x2dmaps.mount",), "mount /data/my-maps"),
        (("-.mount",), "mount /"),
        (("\\x2ehidden.mount",), "mount /.hidden"),
        (
            ("e.service", "d.service", "c.service", "b.service"),
            "b.service, c.service, d.service and 1 more",
        ),
    ],
)
def test_what_a_start_waits_for(units: tuple[str, ...], text: str) -> None:
    assert format_awaited(units) == text
