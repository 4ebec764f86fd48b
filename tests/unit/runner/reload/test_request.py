"""The command of systemctl reload, where there is nobody to ask."""

from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from dora_systemd.runner.reload.request import main


def test_by_hand(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert main() == ExitCode.USAGE
    first, hint = capfd.readouterr().err.splitlines()
    assert first == "cannot run without RUNTIME_DIRECTORY"
    assert "doractl reload" in hint


def test_a_runner_that_is_away_is_an_error_with_a_hint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    assert main() == ExitCode.NOT_RUNNING
    first, hint = capfd.readouterr().err.splitlines()
    assert first.startswith(f"cannot reach the runner of {tmp_path.name}: ")
    assert hint
