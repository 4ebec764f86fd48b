"""Where the lines of nodes on other machines are said to be."""

import pytest

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.gateway.answers import log_line
from dora_systemd.decisions.gateway.page_messages import line_values
from dora_systemd.decisions.logs.records import log_payload
from dora_systemd.decisions.machines.elsewhere import lines_elsewhere

PLACED = (Placed("mid", "gpu"), Placed("eye", "cam"), Placed("ear", "cam"))


@pytest.mark.parametrize(
    ("node", "text"),
    [
        ("", "more lines are in the journal of machines gpu, cam: doractl logs robot"),
        ("eye", "more lines are in the journal of machine cam: doractl logs robot --node eye"),
    ],
)
def test_all_are_told(node: str, text: str) -> None:
    (record,) = lines_elsewhere("robot", PLACED, node, 17_000_000)
    line = line_values(record)
    assert (line["at_us"], line["node"], line["text"]) == (17_000_000, node, text)
    assert text in log_line(record).decode()
    assert log_payload(record, "u")["message"] == text


def test_a_node_of_the_head() -> None:
    assert lines_elsewhere("robot", PLACED, "camera", 17) == []
    assert lines_elsewhere("robot", (), "", 17) == []
