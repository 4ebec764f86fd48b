"""doractl env: what a shell is to read, and where it comes from."""

import shlex
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.dora.command import (
    VARIABLES,
    NodeCommand,
    coordinator_variables,
    format_exports,
    format_unsets,
    parse_node_command,
)
from dora_systemd.decisions.gateway.place import SOCKET_UNIT, token_path
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs import gateway
from dora_systemd.verbs.gateway import read_variables
from tests.unit.fakes.manager import FakeManager, ScopeIn, options
from tests.unit.tools import require

SHOW = '; printf "%s|" "${DORA_COORDINATOR_PORT-none}" "${DORA_DAEMON_LOCAL_LISTEN_PORT-none}"'
FISH = "; echo -n $DORA_COORDINATOR_PORT'|'; set -q DORA_DAEMON_LOCAL_LISTEN_PORT; echo -n $status"


def shell(name: str, script: str, *arguments: str) -> str:
    require(name)
    command = [name, *arguments, "-c", script]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


GATEWAY = coordinator_variables(53290, "ab")
CELL = coordinator_variables(1234, "cd", 5678)


def test_sh_understands_it() -> None:
    cell = format_exports("sh", CELL)
    both = f"{cell}\n{format_exports('sh', GATEWAY)}"
    assert shell("sh", both + SHOW) == "53290|none|"
    assert shell("sh", cell + SHOW) == "1234|5678|"
    assert shell("sh", f"{cell}\n{format_unsets('sh')}{SHOW}") == "none|none|"


def test_fish_understands_it() -> None:
    both = f"{format_exports('fish', CELL)}\n{format_exports('fish', GATEWAY)}"
    assert shell("fish", both + FISH, "--no-config") == "53290|1"


@given(st.text(st.characters(exclude_characters="\0\n")))
def test_values_are_one_word(text: str) -> None:
    line = format_exports("sh", {VARIABLES[2]: text}).split("\n")[0]
    assert shlex.split(line) == ["export", f"{VARIABLES[2]}={text}"]


@pytest.fixture
def scope(tmp_path: Path) -> ScopeIn:
    return ScopeIn(is_user=False, uid=0, root=tmp_path)


@pytest.fixture
def up() -> FakeManager:
    manager = FakeManager()
    facts = {"LoadState": "loaded", "ActiveState": "active"}
    manager.units[SOCKET_UNIT] = {**facts, "Listen": [["Stream", "127.0.0.1:53299"]]}
    return manager


def test_the_gateway(up: FakeManager, scope: ScopeIn) -> None:
    path = token_path(scope)
    path.parent.mkdir()
    path.write_text("secret\n")
    values = read_variables(up, scope, None)
    assert values["DORA_COORDINATOR_PORT"] == "53299"
    assert values["DORA_AUTH_TOKEN"] == "secret"


def test_the_gateway_is_started_for_its_token(
    up: FakeManager, scope: ScopeIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_port: int, _seconds: float) -> bool:
        token_path(scope).parent.mkdir()
        token_path(scope).write_text("new\n")
        return True

    monkeypatch.setattr(gateway, "answers_health", start)
    assert read_variables(up, scope, None)["DORA_AUTH_TOKEN"] == "new"


@pytest.mark.parametrize("active", ["inactive", "failed"])
def test_a_gateway_that_is_down(active: str, up: FakeManager, scope: ScopeIn) -> None:
    up.units[SOCKET_UNIT]["ActiveState"] = active
    with pytest.raises(DoraSystemdError, match="cannot use the gateway: it is not up") as caught:
        read_variables(up, scope, None)
    assert caught.value.code is ExitCode.NOT_RUNNING
    assert caught.value.hint == "doractl up"


@pytest.mark.parametrize(
    ("active", "code"), [("active", ExitCode.NOT_RUNNING), ("inactive", ExitCode.NOT_RUNNING)]
)
def test_a_dataflow_without_a_coordinator(active: str, code: ExitCode, scope: ScopeIn) -> None:
    manager = FakeManager()
    manager.add(options(), active=active)
    with pytest.raises(DoraSystemdError) as caught:
        read_variables(manager, scope, "robot")
    assert caught.value.code is code
    with pytest.raises(DoraSystemdError) as caught:
        read_variables(manager, scope, "nobody")
    assert caught.value.code is ExitCode.NOT_FOUND


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("node restart camera", NodeCommand("restart", "camera")),
        ("node stop camera -d robot", NodeCommand("stop", "camera", "robot")),
        ("node stop --dataflow=robot camera", NodeCommand("stop", "camera", "robot")),
        ("node restart camera --grace 2s", NodeCommand("restart", "camera", "", 2_000_000)),
        ("node restart --grace=1500ms camera", NodeCommand("restart", "camera", "", 1_500_000)),
        ("node restart camera --grace 1h3m", None),
        ("node restart camera --grace", None),
        ("node restart camera plot", None),
        ("node restart", None),
        ("node restart --help", None),
        ("node restart camera --coordinator-port 1", None),
        ("node list", None),
        ("topic list", None),
        ("", None),
    ],
)
def test_what_is_one(line: str, expected: NodeCommand | None) -> None:
    assert parse_node_command(line.split()) == expected


@pytest.mark.parametrize(
    ("what", "told"), [("stop", "Node `a` stopped"), ("restart", "Node `a` restart initiated")]
)
def test_it_is_told_as_by_dora(what: str, told: str) -> None:
    assert NodeCommand(what, "a").told == told
