"""Variables in values of `env:`."""

import pytest

from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.descriptor.expansion import (
    called_variables,
    expanded,
    unset_variables,
)


def test_what_is_named_and_set() -> None:
    node = {"id": "a", "path": "a.py", "args": "$ARGS", "env": {"M": "x${MODEL}y", "N": 5}}
    env = {
        "A": "$KEY/$_k.$MISSING",
        "H": "$HOME",
        "D": "$$PRICE ${",
        "W": "${WITH:-default}",
        "X": "${MODEL",
    }
    dataflow = parse_dataflow({"nodes": [node], "env": env}, "f")
    caller = dict.fromkeys(("MODEL", "KEY", "_k", "HOME", "PRICE", "WITH", "ARGS", "OTHER"), "v")
    assert called_variables(dataflow, caller) == dict.fromkeys(("KEY", "_k", "WITH", "MODEL"), "v")
    assert called_variables(dataflow, {"RUST_LOG": "debug"}) == {"RUST_LOG": "debug"}


def test_what_is_named_and_not_set() -> None:
    node = {"id": "a", "path": "a.py", "env": {"M": "${MODEL}/${LIB:-lib}/$PWD", "N": 5}}
    dataflow = parse_dataflow({"nodes": [node], "env": {"K": "$KEY $KEY"}}, "f")
    assert unset_variables(dataflow, {"PWD": "/srv"}) == ["KEY", "MODEL"]


@pytest.mark.parametrize(
    ("text", "sent"),
    [
        ("plain", "plain"),
        ("$A/${A}", "a/a"),
        ("${NONE:-d} ${A:-d}", "d a"),
        ("${NONE} $NONE", "${NONE} $NONE"),
        ("$$ a$$b $$A", "$$$$ a$$$$b $$$$A"),
        ("$P", "$$$$x"),
        ("5$ $5 ${", "5$ $5 ${"),
        ("inf", "$${DORA_SYSTEMD_NUMBER:-inf}"),
        ("-Infinity", "$${DORA_SYSTEMD_NUMBER:--Infinity}"),
        ("${F}", "$${DORA_SYSTEMD_NUMBER:-NaN}"),
        ("1e999", "$${DORA_SYSTEMD_NUMBER:-1e999}"),
        ("infinite", "infinite"),
        (" inf", " inf"),
        ("1_0", "1_0"),
    ],
)
def test_what_is_sent(text: str, sent: str) -> None:
    assert expanded({"K": text, "N": 5}, {"A": "a", "P": "$x", "F": "NaN"}) == {"K": sent, "N": 5}


def test_braces_that_nobody_closes() -> None:
    text = "${A:-" * 200_000  # once took hours
    dataflow = parse_dataflow({"nodes": [{"id": "a", "path": "a", "env": {"X": text}}]}, "f")
    assert called_variables(dataflow, {"A": "a", "B": "b"}) == {}
    assert expanded({"X": f"${{A}}{text}$A"}, {"A": "a"}) == {"X": f"a{text}a"}
