"""The descriptor as dora gets it: every program replaced by the launcher."""

import shlex
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.launch import (
    LaunchPlan,
    has_pipes,
    kinds,
    launch_descriptor,
    python_of,
)
from dora_systemd.decisions.cell.options import RunnerOptions, parse_setting
from dora_systemd.decisions.descriptor.dataflow import (
    BuildSession,
    parse_dataflow,
    parse_session,
    session_path,
)
from dora_systemd.errors import DoraSystemdError

UUID = "550e8400-e29b-41d4-a716-446655440000"
FILES = {
    "/p/a.py",
    "/p/bin/detector",
    "/p/sub/a.py",
    "/clone/a.py",
    "/usr/bin/cat",
    "/usr/bin/python3",
    "/env/bin/python",
    "/repo/pyproject.toml",
    "/repo/.venv/bin/tool",
}


def plan(session: BuildSession | None = None, **changes: Any) -> LaunchPlan:
    options = RunnerOptions("robot", UUID, "/p/flow.yml", "/p", "/usr/bin/dora", **changes)
    return LaunchPlan(
        options, "/l.sh", "/usr/bin:/bin", FILES.__contains__, read, session or BuildSession()
    )


def read(path: str) -> bytes:
    if path not in FILES:
        raise FileNotFoundError(path)
    return b""


def launch(node: dict[str, Any], given: LaunchPlan | None = None) -> dict[str, Any]:
    flow = parse_dataflow({"nodes": [{"id": "n", **node}]}, "flow.yml")
    nodes = launch_descriptor(flow, given or plan())["nodes"]
    assert isinstance(nodes, list)
    return dict(nodes[0])


def words(node: dict[str, Any], given: LaunchPlan | None = None) -> list[str]:
    launched = launch(node, given)
    assert launched["path"] == "/usr/bin/perl"
    return shlex.split(launched["args"])


@pytest.mark.parametrize(
    ("text", "prefix"), [("no", ["/usr/bin/prlimit", "--core=0:0"]), ("yes", [])]
)
def test_a_node_without_core_dumps(text: str, prefix: list[str]) -> None:
    given = plan(**texts(f"n:core_dumps={text}"))
    assert words({"path": "a.py"}, given)[4:] == [*prefix, "/usr/bin/python3", "-u", "/p/a.py"]
    assert words({"path": "a.py"})[4:] == ["/usr/bin/python3", "-u", "/p/a.py"]


def texts(*words: str) -> dict[str, Any]:
    """The options with [NODE:]KEY=TEXT."""
    return {"settings": tuple(map(parse_setting, words))}


@pytest.mark.parametrize(
    ("node", "changes", "expected"),
    [
        ({"path": "a.py"}, {}, ["/p", "pipe", "/usr/bin/python3", "-u", "/p/a.py"]),
        ({"path": "a.py"}, {"venv": "/v"}, ["/p", "pipe", "/v/bin/python", "-u", "/p/a.py"]),
        ({"path": "a.py"}, {"uv": True}, ["/p", "pipe", "uv", "run", "python", "-u", "/p/a.py"]),
        ({"path": "bin/detector", "args": "-x 'a b' $HOME"}, {},
         ["/p", "pipe", "/p/bin/detector", "-x", "a b", "$HOME"]),
        ({"path": "cat"}, {}, ["/p", "pipe", "/usr/bin/cat"]),
        ({"path": "cat"}, texts("other:watchdog=5s"), ["/p", "pipe", "/usr/bin/cat"]),
        ({"path": "cat"}, texts("n:watchdog=5s"), ["/p", "pipe:5000000", "/usr/bin/cat"]),
        ({"path": "cat"}, texts("n:notify=yes"), ["/p", "pipe:0", "/usr/bin/cat"]),
        ({"path": "shell", "args": "x"}, {"allow_shell_nodes": True, **texts("watchdog=5s")},
         ["/p", "pipe:5000000:any", "sh", "-c", "x"]),
        ({"path": "cat", "send_stdout_as": "log", "outputs": ["log"]}, texts("n:watchdog=5s"),
         ["/p", "keep:5000000", "/usr/bin/cat"]),
        ({"path": "cat", "args": "-n"}, {"uv": True},
         ["/p", "pipe", "uv", "run", "/usr/bin/cat", "-n"]),
        ({"path": "tool", "deploy": {"working_dir": "/repo/flows"}}, {"uv": True},
         ["/repo/flows", "pipe", "uv", "run", "/repo/.venv/bin/tool"]),
        ({"path": "shell", "args": "echo $X | cat"}, {"allow_shell_nodes": True},
         ["/p", "pipe", "sh", "-c", "echo $X | cat"]),
        ({"path": "a.py", "send_stdout_as": "log", "outputs": ["log"]}, {},
         ["/p", "keep", "/usr/bin/python3", "-u", "/p/a.py"]),
        ({"path": "a.py", "deploy": {"working_dir": "sub"}}, {},
         ["/p/sub", "pipe", "/usr/bin/python3", "-u", "/p/sub/a.py"]),
    ],
)  # fmt: skip
def test_commands(node: dict[str, Any], changes: dict[str, Any], expected: list[str]) -> None:
    assert words(node, plan(**changes)) == ["/l.sh", "n", *expected]


def test_dora_has_one_daemon_without_a_name() -> None:
    """A node that dora starts itself may name its own machine, too."""
    deploy = {"machine": "robot-1", "labels": {"arm": "yes"}, "working_dir": "sub"}
    operator: dict[str, Any] = {"operator": {"python": "op.py", "inputs": {}}}
    for more in ({"path": "a.py"}, operator):
        launched = launch({**more, "deploy": deploy})["deploy"]
        assert (launched["machine"], launched["labels"]) == (None, {})


def test_builds() -> None:
    session = BuildSession({"n": "/clone"}, {"n": "/env"})
    node = {"path": "a.py", "git": "https://example.org/x.git", "build": "make", "rev": "1"}
    launched = launch(node, plan(session))
    assert not launched.keys() & {"git", "build", "rev"}
    assert words(node, plan(session))[2:] == [
        "/clone", "pipe", "/usr/bin/python3", "-u", "/clone/a.py",
    ]  # fmt: skip
    assert words(node, plan(session, uv=True))[4] == "/env/bin/python"


def test_python_is_the_first_on_path() -> None:
    assert python_of(plan()) == "/usr/bin/python3"


def test_what_dora_starts_itself_is_left_alone() -> None:
    node = {"path": "dynamic", "inputs": {"tick": "dora/timer/millis/10"}}
    assert launch(node)["path"] == "dynamic"
    assert launch({"path": "a.py", "path_sha256": "0" * 64})["path"] == "a.py"


@pytest.mark.parametrize(
    "operator", [{"python": "op.py"}, {"python": {"source": "op.py", "conda_env": "x"}}]
)
def test_operators_get_absolute_paths(operator: dict[str, Any]) -> None:
    launched = launch({"operator": {**operator, "outputs": ["x"]}})["operator"]["python"]
    assert (launched if isinstance(launched, str) else launched["source"]) == "/p/op.py"


def test_pipes_and_kinds() -> None:
    document = {
        "nodes": [
            {"id": "py", "path": "a.py"},
            {"id": "kept", "path": "a.py", "send_stdout_as": "x", "outputs": ["x"]},
            {"id": "op", "operator": {"python": "op.py"}},
            {"id": "dyn", "path": "dynamic"},
        ]
    }
    flow = parse_dataflow(document, "flow.yml")
    assert [node.id for node in flow.nodes if has_pipes(node)] == ["py", "op"]
    assert kinds(flow, plan(uv=True)) == {
        "py": "uv", "kept": "uv", "op": "operator", "dyn": "dynamic",
    }  # fmt: skip


def test_env_precedence_is_that_of_dora_start() -> None:
    node = {"id": "n", "path": "a.py", "env": {"A": "node"}}
    document = {"env": {"A": "flow", "B": "flow"}, "nodes": [node]}
    made = launch_descriptor(parse_dataflow(document, "f"), plan(env_keys=("A", "B")))
    assert made["env"] == {}
    assert made["nodes"][0]["env"] == {"A": "node"}
    assert document["env"] == {"A": "flow", "B": "flow"}


def test_debug_and_exit_when_nodes_finish() -> None:
    document = {"debug": {"x": 1}, "nodes": [{"id": "n", "path": "a.py"}]}
    made = launch_descriptor(
        parse_dataflow(document, "f"), plan(debug=True, exit_when_nodes_finish=False)
    )
    assert made["debug"] == {"x": 1, "enable_debug_inspection": True}
    assert made["exit_when_nodes_finish"] is False


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ({}, (None, None)),
        ({"restart_policy": "never"}, (None, None)),
        ({"restart_policy": "on-failure"}, (0.5, 30.0)),
        ({"restart_policy": "always", "restart_delay": 0.1}, (0.5, 30.0)),
        ({"restart_policy": "always", "restart_delay": 60}, (60.0, 60.0)),
        ({"restart_policy": "on-failure", "restart_delay": 1, "max_restart_delay": 2}, (1.0, 2.0)),
    ],
)
def test_restart_delays_are_bounded(node: dict[str, Any], expected: tuple[Any, Any]) -> None:
    made = launch({"path": "a.py", **node})
    assert (made.get("restart_delay"), made.get("max_restart_delay")) == expected


@pytest.mark.parametrize(
    ("node", "words"),
    [
        ({"path": "nope.py"}, "node n: its path 'nope.py' is neither in /p nor in PATH"),
        ({"path": "shell", "args": "true"}, "shell nodes are not allowed"),
        ({"path": "a.py", "git": "https://example.org/x"}, "was not built"),
        ({"path": "a.py", "args": "'"}, "its args"),
    ],
)
def test_refusals(node: dict[str, Any], words: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot start flow\.yml: node n: ") as caught:
        launch(node)
    assert words in caught.value.message
    assert caught.value.hint


HINTS: tuple[tuple[dict[str, Any], tuple[str, ...], str], ...] = (
    ({"path": "robot-camera"}, (), "correct the path of the node"),
    ({"path": "robot-camera"}, ("/p/uv.lock",), "run `doractl build flow.yml` first, or"),
    ({"path": "robot-camera"}, ("/p/pyproject.toml",), "run `uv sync` in /p first, or correct"),
    ({"path": "src/nope.py"}, ("/p/uv.lock",), "correct the path of the node"),
    (
        {"path": "robot-camera", "build": "make"},
        ("/p/uv.lock",),
        "run `doractl build flow.yml` first",
    ),
    ({"path": "a.py", "git": "https://example.org/x"}, (), "run `doractl build flow.yml` first"),
)


@pytest.mark.parametrize(("node", "files", "expected"), HINTS)
def test_what_makes_a_missing_program(
    node: dict[str, Any], files: tuple[str, ...], expected: str
) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        launch(node, plan()._replace(exists=files.__contains__))
    assert str(caught.value.hint).startswith(expected)


@given(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])))
def test_shell_text_survives(text: str) -> None:
    made = words({"path": "shell", "args": text}, plan(allow_shell_nodes=True))
    assert made[-1] == text


def test_sessions() -> None:
    assert str(session_path("/p/flow.yml")) == "/p/out/flow.dora-session.yaml"
    build = {"node_working_dirs": {"a": "/c"}, "python_env_dirs": {"a": "/e"}}
    assert parse_session({"local_build": build}) == BuildSession({"a": "/c"}, {"a": "/e"})
    odd: list[object] = [None, [], {}, {"local_build": None}]
    for one in (*odd, {"local_build": {"node_working_dirs": 3}}):
        assert parse_session(one) == BuildSession()
