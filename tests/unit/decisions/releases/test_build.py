"""What a build is, and what is made of its lines."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.properties.assignments import typed, with_assignments
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.releases.build import (
    BuildTask,
    build_commands,
    build_environment,
    build_properties,
    build_unit,
    built_nodes,
    format_task,
    has_builds,
    is_moving,
    is_output,
    lock_places,
    parse_task,
    parse_uv_error,
    shown_line,
)

PLAIN = {"id": "plain", "path": "a.py"}
NODES: tuple[tuple[dict[str, Any], bool], ...] = (
    (PLAIN, False),
    ({**PLAIN, "build": "make"}, True),
    ({**PLAIN, "git": "https://host/a"}, True),
    ({"id": "a", "operator": {"python": "a.py", "build": "make"}}, True),
    ({"id": "a", "operators": [{"id": "x", "python": "a.py"}]}, False),
    ({"id": "a", "operators": [{"id": "x", "python": "a.py", "build": "make"}]}, True),
)


@pytest.mark.parametrize(("node", "is_built"), NODES)
def test_which_nodes_are_built(node: dict[str, Any], is_built: bool) -> None:
    dataflow = parse_dataflow({"nodes": [{**node, "id": "a"}, {**PLAIN, "id": "b"}]}, "/x.yml")
    assert built_nodes(dataflow) == ["a"] * is_built


@pytest.mark.parametrize(
    ("node", "moves"),
    [
        (PLAIN, False),
        ({**PLAIN, "build": "make"}, False),
        ({**PLAIN, "git": "https://host/a"}, True),
        ({**PLAIN, "git": "https://host/a", "branch": "main"}, True),
        ({**PLAIN, "git": "https://host/a", "rev": "1234567"}, False),
        ({**PLAIN, "git": "https://host/a", "tag": "v1"}, False),
        ({"module": "m.yml"}, True),
    ],
)
def test_what_may_build_another_program_next_time(node: dict[str, Any], moves: bool) -> None:
    nodes = [{**PLAIN, "id": "b"}, {**node, "id": "a"}]
    assert is_moving(parse_dataflow({"nodes": nodes}, "/x.yml")) == moves


def test_modules_that_ask_for_a_build() -> None:
    assert not has_builds({"nodes": [PLAIN], "module": {"name": "m"}} | {"module": None})
    assert has_builds({"nodes": [PLAIN, {**PLAIN, "build": "make"}]})
    assert has_builds({"nodes": [{"id": "n", "module": "other.yml"}]})
    assert not has_builds("build")
    endless: list[object] = []
    endless.append(endless)
    for _ in range(100):
        endless = [endless, endless]  # as aliases of YAML can
    assert not has_builds(endless)


def test_the_commands_and_their_order() -> None:
    dora = ("/bin/dora", "build", "--local", "/r/tree/flows/x.yml")
    sync = ("/bin/uv", "sync", "--frozen", "--directory")
    flow = "flows/x.yml"
    assert build_commands(["a.py"], "/r/tree", flow, "/bin/uv", "/bin/dora") == (dora,)
    assert build_commands(["uv.lock"], "/r/tree", flow, "", "") == ()
    found = build_commands(["uv.lock"], "/r/tree", flow, "/bin/uv", "/bin/dora")
    assert found == ((*sync, "/r/tree"), dora)
    found = build_commands(["uv.lock", "flows/uv.lock"], "/r/tree", flow, "/bin/uv", "")
    assert found == ((*sync, "/r/tree/flows"),)
    first, compiles = build_commands([], "/r/tree", flow, "", "/bin/dora", "flows/.venv")
    assert (first, compiles[-2:]) == (dora, ("/r/tree/flows/.venv", "/r/tree"))
    assert build_commands([], "/r/tree", flow, "", "", ".venv") == ()


def test_the_environment() -> None:
    given = {"PATH": "/p/.venv/bin:/usr/bin", "VIRTUAL_ENV": "/p/.venv", "UV_NO_CACHE": "0"}
    found = build_environment(given, "/r/tree/.venv", "/p/.venv")
    assert found["PATH"] == "/r/tree/.venv/bin:/usr/bin"
    assert found["VIRTUAL_ENV"] == found["UV_PROJECT_ENVIRONMENT"] == "/r/tree/.venv"
    assert found["UV_NO_CACHE"] == "0"
    found = build_environment(given, "/r/tree/.venv", "/p/.venv", "/own")
    assert found["PATH"] == "/r/tree/.venv/bin:/own:/usr/bin"
    assert build_environment(given, None, "/p/.venv")["PATH"] == given["PATH"]


def test_equal_sources_are_compiled_to_equal_files(tmp_path: Path) -> None:
    """Wherever the release is; and what cannot be compiled is no failure."""
    compiled = []
    for place in (tmp_path / "first", tmp_path / "second one"):
        packages = place / ".venv/lib/python3/site-packages"
        packages.mkdir(parents=True)
        (place / ".venv/bin").mkdir()
        (place / ".venv/bin/python").symlink_to(sys.executable)
        (packages / "a.py").write_text("def f(): return 1")
        (packages / "bad.py").write_text("print 'two'")
        *_, command = build_commands([], str(place), "x.yml", "", "/bin/dora", ".venv")
        assert subprocess.run(command, check=False).returncode == 0
        (made,) = (packages / "__pycache__").glob("*.pyc")
        compiled.append(made.read_bytes())
    assert compiled[0] == compiled[1]
    assert compiled[0][4] == 0b11, "valid by the source's content"
    *_, command = build_commands([], str(tmp_path), "x.yml", "", "/bin/dora", ".venv")
    assert subprocess.run(command, check=False).returncode == 0, "the build has made none"


LINES = {
    "a: stdout   hello": ("a: hello", True),
    "a: INFO     running build command: `make`": ("a: running build command: `make`", False),
    "Resolved 3 packages": ("Resolved 3 packages", False),
    "\x1b[31ma: stderr   oh\x1b[0m": ("a: oh", True),
    "a: stdout   " + "x" * 999: (None, True),
}


@pytest.mark.parametrize(("line", "expected"), LINES.items())
def test_lines(line: str, expected: tuple[str | None, bool]) -> None:
    words, is_of_command = expected
    assert words is None or shown_line(line) == words
    assert len(shown_line(line)) <= 300
    assert is_output(line) == is_of_command


def test_a_task_as_text() -> None:
    task = BuildTask("robot", "u", "20260101T000000", "/r/tree", (("uv", "sync"), ("dora", "b $x")))
    assert parse_task(format_task(task)) == task


UV = {
    "Using CPython 3.13.5\nerror: Failed to parse\n  cause: TOML error\n   2 | [[\n     |   ^": (
        "uv: Failed to parse: TOML error 2 | [[ | ^"
    ),
    "error: no\nerror: Failed to build `bad`\n  cause: it failed\n\n     [stderr]\n     No module\n"
    "\nhint: `bad` was included\n\nhint: more": (
        "uv: Failed to build `bad`: it failed [stderr] No module"
    ),
    "\x1b[31m  ×\x1b[0m Failed to build `bad`\n  ├─▶ it failed\n  ╰─▶ so": (
        "uv: Failed to build `bad`: it failed: so"
    ),
    "Using CPython 3.13.5\nKilled": "",
    "": "",
}


@pytest.mark.parametrize(("printed", "expected"), UV.items())
def test_what_uv_gives_as_its_reason(printed: str, expected: str) -> None:
    assert parse_uv_error(printed) == expected


def test_where_a_release_is_built() -> None:
    assert build_unit("robot") == "doractl-build-robot.service"
    assert lock_places("flows/x.yml") == ("flows/uv.lock", "uv.lock")
    assert lock_places("x.yml") == ("uv.lock", "uv.lock")


def test_all_variables_of_a_build() -> None:
    always = {
        **{"SOURCE_DATE_EPOCH": "315532800", "UV_COMPILE_BYTECODE": "0", "UV_NO_CACHE": "1"},
        **{"UV_LINK_MODE": "copy", "UV_PYTHON_DOWNLOADS": "never"},
        **{"UV_PYTHON_PREFERENCE": "only-system", "PIP_NO_INPUT": "1", "GIT_TERMINAL_PROMPT": "0"},
    }
    assert build_environment({}, None, None) == always
    own = {"VIRTUAL_ENV": "/v", "UV_PROJECT_ENVIRONMENT": "/v"}
    assert build_environment({"A": "b"}, "/v", None) == {
        **{**always, **own, "A": "b", "PATH": "/v/bin:"}
    }
    given = {"PATH": "/bin:/old/bin:/usr/bin"}
    assert build_environment(given, "/v", "/old")["PATH"] == "/v/bin:/bin:/old/bin:/usr/bin"


@pytest.mark.parametrize("key", ["build", "git", "module"])
def test_the_keys_that_make_a_build(key: str) -> None:
    assert has_builds([{}, {"nodes": [{key: "x"}]}])
    assert not has_builds({"nodes": [{key: ""}]})
    shared: dict[str, object] = {"path": "a.py"}
    assert has_builds([shared, shared, {key: "x"}]), "what comes twice ends nothing"


def test_a_node_with_other_things_in_the_place_of_operators() -> None:
    for operators in ("x", {"build": "make"}, ["x"], None):
        node = {"id": "a", "path": "a.py", "operators": operators, "operator": "x"}
        dataflow = parse_dataflow({"nodes": [{"id": "b", "path": "b"}]}, "/x.yml")
        node_of = dataflow.nodes[0]._replace(raw=node)
        assert built_nodes(dataflow._replace(nodes=(node_of,))) == []


def test_commands_without_a_lock() -> None:
    assert build_commands(["a.py"], "/r", "x.yml", "/bin/uv", "") == ()


def test_long_errors_of_uv_are_cut() -> None:
    assert len(parse_uv_error("error: " + "x" * 999)) == 300
    assert len(shown_line("x" * 300)) == 300
    assert parse_uv_error("  error: indented") == ""
    assert parse_uv_error("warning: x\nerror: a\n  Caused by: b") == "uv: a: b"
    assert parse_uv_error(" × a\n │ b\n ├─▶ c") == "uv: a │ b: c"


@pytest.mark.parametrize(
    ("line", "shown", "is_of_command"),
    [
        ("a-b.c: stderr x", "a-b.c: x", True),
        ("a: stdout   ", "a: stdout", False),
        ("a b: stdout x", "a b: stdout x", False),
        ("a: warn x", "a: warn x", False),
        (" a: WARN  x ", "a: x", False),
    ],
)
def test_lines_of_a_node(line: str, shown: str, is_of_command: bool) -> None:
    assert (shown_line(line), is_output(line)) == (shown, is_of_command)


SANDBOX = ["ProtectSystem=strict", "NoNewPrivileges=yes", "TemporaryFileSystem=/run/x:ro"]
OTHERS = [
    *("LoadCredential=a:/b", "CPUSchedulingPolicy=fifo", "Nice=-5", "LimitRTPRIO=50"),
    *("Requires=other.service", "After=other.service", "OOMScoreAdjust=-500"),
]


def made(own: dict[str, Property], is_user: bool = False) -> dict[str, Property]:
    return build_properties(own, "/s/.build/tree", "/s/n/id/tree", "/s", {"A": "b"}, 7, is_user)


def test_it_has_the_sandbox_and_no_rights() -> None:
    own = with_assignments({}, [*SANDBOX, *OTHERS]) | typed(User="eve", Slice="dora.slice")
    found = made(own)
    for key in ("ProtectSystem", "NoNewPrivileges", "User", "Slice"):
        assert found[key] == own[key]
    for line in OTHERS:
        assert not any(slot.startswith(line.partition("=")[0]) for slot in found)
    assert found["TemporaryFileSystem"].value == (("/run/x", "ro"), ("/s", "ro"))
    assert found["BindPaths"].value[0][:2] == ("/s/.build/tree", "/s/n/id/tree")
    assert (found["Type"].value, found["TimeoutStartSec"].value) == ("oneshot", 7)
    assert found["Environment"].value == ("A=b",)
    assert "PrivateUsers" not in found


def test_a_limit_of_memory_is_kept() -> None:
    assert made({})["MemoryMax"].name == "MemoryMaxScale"
    own = with_assignments({}, ["MemoryMax=1G"])
    assert made(own)["MemoryMax"].value == 1024**3


def test_in_user_scope_mounts_need_a_namespace() -> None:
    assert made({}, is_user=True)["PrivateUsers"].value is True
