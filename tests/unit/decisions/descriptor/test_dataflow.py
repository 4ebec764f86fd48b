"""The descriptor: what dora-systemd reads of it, which nodes depend on which, the words of args."""

import shlex
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.descriptor.dataflow import (
    MAX_JSON,
    Dataflow,
    called_variables,
    downstream_of,
    expanded,
    parse_dataflow,
    unset_variables,
)
from dora_systemd.decisions.descriptor.nodes import Input, NodeKind, split_arguments
from dora_systemd.decisions.dora.errors import parse_dora_error
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import one_line

CAMERA: dict[str, Any] = {"id": "camera", "path": "camera.py", "outputs": ["image"]}


def flow(*nodes: object, **keys: object) -> Dataflow:
    return parse_dataflow({"nodes": list(nodes), **keys}, "robot.yml")


def refusal(*nodes: object) -> str:
    with pytest.raises(DoraSystemdError) as caught:
        flow(*nodes)
    assert caught.value.code == ExitCode.BAD_INPUT
    assert caught.value.hint
    return caught.value.message


def test_what_is_read() -> None:
    detector = {
        "id": "detector",
        "path": "./detector",
        "args": "--fast",
        "env": {"MODEL": "x.pt"},
        "inputs": {"image": "camera/image", "tick": {"source": "dora/timer/millis/20"}},
        "restart_policy": "on-failure",
        "restart_delay": 0.5,
        "build": "cargo build",
        "git": "https://example.org/detector",
        "send_stdout_as": "log",
        "deploy": {"working_dir": "sub"},
        "unheard_of": 1,
    }
    dataflow = flow(CAMERA, detector, env={"A": 1}, exit_when_nodes_finish=True)
    node = dataflow.node("detector")
    assert node
    assert (node.kind, node.path, node.args) == (NodeKind.EXECUTABLE, "./detector", "--fast")
    assert node.inputs == (Input("image", "camera/image"), Input("tick", "dora/timer/millis/20"))
    assert (node.restart_policy, node.backoff) == ("on-failure", {"restart_delay": 0.5})
    assert (node.build, node.git) == ("cargo build", "https://example.org/detector")
    assert node.keeps_output
    assert node.working_directory == "sub"
    assert node.raw["unheard_of"] == 1
    assert (dataflow.env, dataflow.exit_when_nodes_finish) == ({"A": 1}, True)
    assert dataflow.node("nobody") is None


@pytest.mark.parametrize(
    ("keys", "kind"),
    [
        ({"path": "x.py"}, NodeKind.PYTHON),
        ({"path": "bin/x"}, NodeKind.EXECUTABLE),
        ({"path": "shell", "args": "echo"}, NodeKind.SHELL),
        ({"path": "dynamic"}, NodeKind.DYNAMIC),
        ({"path": "https://example.org/x"}, NodeKind.URL),
        ({"operator": {"python": "x.py"}}, NodeKind.OPERATOR),
        ({"operators": [{"id": "a", "python": "x.py"}]}, NodeKind.OPERATOR),
        ({"ros2": {"topic": "/x"}}, NodeKind.ROS2),
        ({"module": "x.yml"}, NodeKind.MODULE),
        ({"hub": "x"}, NodeKind.HUB),
    ],
)
def test_kinds(keys: dict[str, Any], kind: NodeKind) -> None:
    assert flow({"id": "a", **keys}).nodes[0].kind == kind


def test_operators_have_inputs_and_outputs() -> None:
    one = {
        "id": "one",
        "operator": {"python": "x.py", "outputs": ["o"], "inputs": {"i": "two/b/o"}},
    }
    part = {"id": "b", "python": "x.py", "outputs": ["o"], "inputs": {"i": "one/o"}}
    dataflow = flow(one, {"id": "two", "operators": [part]})
    assert dataflow.nodes[0].outputs == {"o"}
    assert dataflow.nodes[1].outputs == {"b/o"}
    assert dataflow.nodes[1].inputs == (Input("b/i", "one/o"),)


def test_outputs_of_modules_are_not_known() -> None:
    user = {"id": "a", "path": "a.py", "inputs": {"x": "m/out", "y": "m.inner/out"}}
    assert flow({"id": "m", "module": "m.yml"}, user)


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        ([], "it holds a list"),
        ("text", "it holds the text 'text'"),
        (None, "it holds nothing"),
        (5, "it holds a number"),
        ({}, "it has no nodes"),
        ({"nodes": []}, "it has no nodes"),
        ({"nodes": None}, "it has no nodes"),
        ({"nodes": {"id": "a"}}, "'nodes' is a mapping"),
        ({"nodes": ["a"]}, "node 1 is the text 'a'"),
        ({"nodes": [{"id": "a", "path": "x"}], "env": 5}, "'env' is a number"),
        ({1: 2}, "a key in it is int, not text"),
        ({"a": {1, 2}}, "a value in it is of type set"),
        ({"a": float("inf")}, "a value in it is infinite (.inf)"),
        ({"a": float("-inf")}, "a value in it is infinite (.inf)"),
        ({"a": float("nan")}, "a value in it is not a number (.nan)"),
        ({"a": 2**70}, "a number in it is too large for JSON"),
        ({"a": "\udcff"}, "a text in it is not Unicode"),
    ],
)
def test_documents_that_are_no_dataflows(document: object, reason: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_dataflow(document, "robot.yml")
    assert caught.value.message == f"cannot use robot.yml: {reason}"


@pytest.mark.parametrize(
    ("node_id", "reason"),
    [
        (None, "has no id"),
        (1, "is a number"),
        (True, "is true or false"),
        ("", "has the id ''"),
        ("a/b", "has the id 'a/b'"),
        ("a b", "has the id 'a b'"),
        ("..", "has the id '..'"),
        ("ü", "has the id 'ü'"),
        ("a\n", r"has the id 'a\n'"),
        ("dora", "has the id 'dora'"),
        ("x" * 201, "has the id 'xxx"),
    ],
)
def test_bad_ids(node_id: object, reason: str) -> None:
    assert reason in refusal(CAMERA, {"id": node_id, "path": "x.py"})


@pytest.mark.parametrize(
    ("nodes", "reason"),
    [
        ([CAMERA, CAMERA], "two nodes have the id camera"),
        ([{"id": "a"}], "node a has no path"),
        ([{"id": "a", "path": "x", "inputs": ["b/c"]}], "node a: 'inputs' is a list"),
        ([{"id": "a", "path": "x", "outputs": "b"}], "node a: 'outputs' is the text 'b'"),
        ([{"id": "a", "path": "x", "env": ["b"]}], "node a: 'env' is a list"),
        ([{"id": "a", "operators": [1]}], "node a: an operator is a number"),
    ],
)
def test_bad_nodes(nodes: list[object], reason: str) -> None:
    assert refusal(*nodes) == f"cannot use robot.yml: {reason}"


@pytest.mark.parametrize(
    ("key", "hint"),
    [("paht", "did you mean path?"), ("oprator", "did you mean operator or operators?"),
     ("outputs", "a node needs one of path, "), (7, "put the key in quotes")],
)  # fmt: skip
def test_a_misspelled_key(key: object, hint: str) -> None:
    node = {"id": "a", key: "x", "inputs": {}, "git": "x", "description": "x"}
    with pytest.raises(DoraSystemdError) as caught:
        parse_dataflow({"nodes": [node]}, "robot.yml")
    assert caught.value.hint.startswith(hint)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("nobody/image", "a node that does not exist"),
        ("camera/depth", "an output that it does not declare"),
        ("camera", "which names no output"),
        (None, "which names no output"),
        (["camera/image"], "which names no output"),
    ],
)
def test_inputs_from_nowhere(source: object, reason: str) -> None:
    message = refusal(CAMERA, {"id": "b", "path": "b.py", "inputs": {"x": source}})
    assert message.startswith("cannot use robot.yml: node b: input 'x' comes from")
    assert message.endswith(reason)


def test_anchors_that_explode_are_refused_at_once() -> None:
    bomb: Any = "x" * 10
    for _ in range(40):
        bomb = [bomb] * 10
    assert "too large" in refusal({**CAMERA, "env": {"A": bomb}})


def test_documents_that_hold_themselves_are_refused() -> None:
    circle: list[Any] = []
    circle.append(circle)
    assert "nested more than" in refusal({**CAMERA, "env": {"A": circle}})


def test_more_than_dora_takes_is_refused() -> None:
    assert "too large" in refusal({**CAMERA, "args": "x" * MAX_JSON})


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)
node_keys = st.sampled_from(
    ["id", "path", "inputs", "outputs", "env", "operator", "operators", "deploy", "args", "ros2"]
)


@given(
    st.lists(st.dictionaries(node_keys, json_values | st.just("camera/image")), max_size=3)
    | json_values
)
def test_any_document_is_read_or_refused(nodes: Any) -> None:
    try:
        parse_dataflow({"nodes": [CAMERA, *nodes] if isinstance(nodes, list) else nodes}, "x.yml")
    except DoraSystemdError as error:
        assert error.message.startswith("cannot use x.yml: ")
        assert error.message.isprintable()


WIRING = """Validating x.yml...


[ERROR]
wiring check failed

Caused by:
    source node `b` mapped to input `a/a` does not exist

Location:
    libraries/core/src/descriptor/validate.rs:562:17
"""
PARSING = """
\x1b[31m[ERROR]\x1b[0m
failed to read dataflow at `x.yml`

  hint: check the file exists, is valid YAML, and matches the dataflow schema

Caused by:
   0: failed to parse given descriptor
   1: nodes[0]: unknown field `foo`, expected one of `a`, `b`, `c`, `d`, `e`, `f`, `g` at line 1

Location:
    libraries/core/src/descriptor/mod.rs:487:38

Stack backtrace:
   0: <unknown>
"""
MISSING = """[ERROR]
failed

Caused by:
   0: first
   1: module file not found: m.yml
   2: No such file or directory (os error 2)
"""


@pytest.mark.parametrize(
    ("stderr", "reason"),
    [
        (WIRING, "source node `b` mapped to input `a/a` does not exist"),
        (PARSING, "nodes[0]: unknown field `foo` at line 1"),
        (
            PARSING.replace("`foo`", "`paht`").replace("`g`", "`path`"),
            "nodes[0]: unknown field `paht` (did you mean path?) at line 1",
        ),
        (MISSING, "module file not found: m.yml: No such file or directory (os error 2)"),
        ("[ERROR]\ncannot connect\n\n  hint: x\n", "cannot connect"),
        ("error: unexpected argument '-x'\n\nUsage: dora\n", "error: unexpected argument '-x'"),
        ("one\ntwo\n\n", "two"),
        ("", ""),
    ],
)
def test_dora_errors_in_one_line(stderr: str, reason: str) -> None:
    assert parse_dora_error(stderr) == reason


@given(st.text() | st.lists(st.sampled_from([*PARSING.splitlines(), "x" * 500])).map("\n".join))
def test_any_output_becomes_one_short_line(stderr: str) -> None:
    reason = parse_dora_error(stderr)
    assert one_line(reason) == reason
    assert len(reason) <= 300


def kept(*sources: str) -> list[str]:
    """The nodes whose output dora must read when a node has inputs from `sources`."""
    inputs = {f"i{place}": source for place, source in enumerate(sources)}
    taker = {"id": "taker", "path": "t.py", "inputs": inputs}
    return [node.id for node in flow(CAMERA, taker).nodes if node.keeps_output]


def test_whose_output_dora_must_read() -> None:
    assert kept("camera/image", "dora/timer/secs/1") == []
    assert kept("dora/logs") == kept("dora/logs/info") == ["camera", "taker"]
    assert kept("dora/logs/info/camera") == ["camera"]
    operator = {"python": "o.py", "outputs": ["words"], "send_stdout_as": "words"}
    for node in ({"operator": operator}, {"operators": [{"id": "a", **operator}]}):
        assert flow({"id": "one", **node}).nodes[0].keeps_output
    assert flow({"id": "one", "path": "o.py", "min_log_level": "info"}).nodes[0].keeps_output


def test_a_large_dataflow_is_no_more_than_its_nodes() -> None:
    assert _calls(chain(200)) < 8 * _calls(chain(50))


def chain(length: int) -> dict[str, Any]:
    inputs = [{"i": f"a{place - 1}/o"} if place else {} for place in range(length)]
    nodes = [
        {"id": f"a{n}", "path": "x", "outputs": ["o"], "inputs": i} for n, i in enumerate(inputs)
    ]
    return {"nodes": nodes}


def _calls(document: dict[str, Any]) -> int:
    """Calls of functions of C while it is read: unlike time, the same on every machine."""
    seen: list[str] = []
    sys.setprofile(lambda _frame, event, _arg: seen.append(event))
    try:
        parse_dataflow(document, "f")
    finally:
        sys.setprofile(None)
    return seen.count("c_call")


def test_infinite_numbers_in_env_are_texts() -> None:
    env = {"A": float("inf"), "B": float("nan"), "C": 0.5}
    node = {"id": "one", "path": "o.py", "env": {"A": float("-inf")}}
    read = parse_dataflow({"nodes": [node], "env": env}, "f.yml")
    assert read.env == {"A": "inf", "B": "nan", "C": 0.5}
    assert read.nodes[0].env == read.nodes[0].raw["env"] == {"A": "-inf"}


NODES = [
    {"id": "a", "path": "a", "outputs": ["x"], "inputs": {"t": "dora/timer/millis/1"}},
    {"id": "b", "path": "b", "inputs": {"x": {"source": "a/x"}}, "outputs": ["y"]},
    {"id": "c", "path": "c", "inputs": {"y": "b/y", "x": "a/x"}, "outputs": ["z"]},
    {"id": "d", "path": "d", "inputs": {"z": "c/z"}},
]


def test_chain_and_circle() -> None:
    found = downstream_of(parse_dataflow({"nodes": NODES}, "f"))
    assert found == {"a": ("b", "c", "d"), "b": ("c", "d"), "c": ("d",), "d": ()}
    circle = [{**NODES[0], "inputs": {"z": "c/z"}}, *NODES[1:3]]
    assert downstream_of(parse_dataflow({"nodes": circle}, "f"))["b"] == ("c", "a")


CASES = {
    "": [],
    " \t\n": [],
    "a  b\tc\nd": ["a", "b", "c", "d"],
    "--name 'a b' \"c d\"": ["--name", "a b", "c d"],
    "''": [""],
    "a''b\"c\"": ["abc"],
    "one \\\ntwo": ["one", "two"],
    "a\\\nb": ["ab"],
    "a\\ b \\'": ["a b", "'"],
    '"a\\$b" "\\`" "\\"" "\\\\"': ["a$b", "`", '"', "\\"],
    '"a\\nb" "x\\\ny"': ["a\\nb", "xy"],
    "'a\\b'": ["a\\b"],
    "#ff0000": [],
    "--colour #ff0000\n--next": ["--colour", "--next"],
    "a#b '#c'": ["a#b", "#c"],
    "a\rb": ["a\rb"],
    "$HOME `x` *": ["$HOME", "`x`", "*"],
}


@pytest.mark.parametrize("text", CASES)
def test_as_dora(text: str) -> None:
    assert split_arguments(text) == CASES[text]


@pytest.mark.parametrize("text", ["'a", '"a', 'a "b\\"', "a\\", '"\\'])
def test_unfinished(text: str) -> None:
    with pytest.raises(ValueError, match=r"a quote is open|a backslash ends it"):
        split_arguments(text)


@given(st.lists(st.text(st.characters(codec="utf-8"))))
def test_quoted_words_come_back(words: list[str]) -> None:
    assert split_arguments(shlex.join(words)) == words


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
