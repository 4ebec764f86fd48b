"""Children: their output, their time limit, and the dora command."""

import sys
import threading
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.host import process
from dora_systemd.errors import DoraSystemdError, ExitCode


def make_program(path: Path, text: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def test_status_and_streams() -> None:
    done = process.run_command(["/bin/sh", "-c", "echo out; echo err >&2; exit 3"], 10)
    assert done == process.Completed(3, "out\n", "err\n")


def test_signal_is_a_negative_status() -> None:
    assert process.run_command(["/bin/sh", "-c", "kill -9 $$"], 10).status == -9


def test_output_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "OUTPUT_LIMIT", 1000)
    done = process.run_command([sys.executable, "-c", "print('x' * 10_000_000)"], 30)
    assert done.status == 0
    assert len(done.stdout) == 1000


def test_a_child_that_hangs_is_killed_with_its_children() -> None:
    begin = time.monotonic()
    with pytest.raises(DoraSystemdError, match=r"^cannot wait for"):
        process.run_command(["/bin/sh", "-c", "sleep 100 & sleep 100"], 0.2)
    assert time.monotonic() - begin < 90


def test_what_cannot_be_run() -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot run /nowhere/x"):
        process.run_command(["/nowhere/x"], 1)


def test_dora_is_told_to_print_plainly(tmp_path: Path) -> None:
    dora = make_program(tmp_path / "dora", 'echo "$NO_COLOR $RUST_BACKTRACE $1"')
    assert process.run_dora(dora, ["validate"], None, {}).stdout == "1 0 validate\n"


def test_dora_given_wins_over_venv_and_path(tmp_path: Path) -> None:
    given_dora, venv, other = (
        make_program(tmp_path / place / "dora", "") for place in ("given", "venv/bin", "other")
    )
    search_path = str(Path(other).parent)
    environment = str(tmp_path / "venv")
    assert process.find_dora(given_dora, environment, search_path) == given_dora
    assert process.find_dora(None, environment, search_path) == venv
    assert process.find_dora(None, None, search_path) == other


def test_dora_beside_our_own_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As pip has installed both; PATH wins over it."""
    own, other = (make_program(tmp_path / place / "dora", "") for place in ("own", "other"))
    monkeypatch.setattr("sys.executable", str(tmp_path / "own/python3"))
    assert process.find_dora(None, None, "/nowhere") == own
    assert process.find_dora(None, None, str(tmp_path / "other")) == other


@pytest.mark.parametrize("given_dora", [None, "/nowhere/dora"])
def test_no_dora(given_dora: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/nowhere/python3")
    with pytest.raises(DoraSystemdError) as caught:
        process.find_dora(given_dora, None, "/nowhere")
    assert caught.value.code is ExitCode.NO_DORA
    assert "pip install" in caught.value.hint


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("echo dora-cli 0.5.0", "it is dora 0.5.0"),
        ("echo something else", "something else"),
        ("exit 1", "it tells no version"),
    ],
)
def test_a_dora_that_is_none(tmp_path: Path, script: str, reason: str) -> None:
    dora = make_program(tmp_path / "dora", script)
    with pytest.raises(DoraSystemdError, match=reason) as caught:
        process.dora_version(dora)
    assert caught.value.code is ExitCode.NO_DORA


def test_version(tmp_path: Path) -> None:
    assert process.dora_version(make_program(tmp_path / "dora", "echo dora-cli 1.1.0")) == "1.1.0"


@given(st.text())
def test_any_text_has_a_version_or_none(text: str) -> None:
    version = process.parse_dora_version(text)
    assert version is None or process.version_numbers(version)


def test_calls_beside_each_other_take_the_time_of_one() -> None:
    meeting = threading.Barrier(2, timeout=30)
    calls = [process.Beside(meeting.wait) for _ in range(2)]
    assert {call.result() for call in calls} == {0, 1}


def test_call_beside_raises_where_its_result_is_wanted() -> None:
    call = process.Beside(lambda: process.run_command(["/nowhere/x"], 1))
    with pytest.raises(DoraSystemdError, match="cannot run /nowhere/x"):
        call.result()
