"""Which input dora means when it says that no variant of an enum has matched."""

from typing import Any

import pytest

from dora_systemd.decisions.dora.errors import name_input

SAID = "nodes[0].inputs: data did not match any variant of untagged enum InputDef at line 2"
TIMER = "dora/timer/millis/50"


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("dora/timer/millis/5milis", ".t: 'dora/timer/millis/5milis' is not a timer such as"),
        ("dora/timer/milis/50", ".t: 'dora/timer/milis/50' is not a timer such as"),
        ("camera", ".t: 'camera' is not NODE/OUTPUT"),
        (5, ".t: it has no source"),
        ({"source": TIMER, "queue_size": "5milis"}, ".t: queue_size is '5milis', and not a number"),
        ({"source": TIMER, "input_timeout": "5s"}, ".t: input_timeout is '5s', and not a number"),
        ({"queue_size": 5}, ".t: it has no source"),
        ({"source": TIMER, "new": []}, ": it is not NODE/OUTPUT, a timer, or a mapping"),
    ],
)
def test_the_input_is_named(value: Any, told: str) -> None:
    document = {"nodes": [{"inputs": {"good": TIMER, "also": "camera/image", "t": value}}]}
    named = name_input(SAID, document)
    assert named.startswith(f"nodes[0].inputs{told}")
    assert named.endswith(" at line 2")
    assert "enum" not in named


@pytest.mark.parametrize("document", [None, [], {}, {"nodes": []}, {"nodes": [5]}, {"nodes": [{}]}])
def test_no_document_can_break_it(document: Any) -> None:
    assert "a mapping with a source at line 2" in name_input(SAID, document)
    assert name_input("something else", document) == "something else"
