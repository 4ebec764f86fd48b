"""What a machine says that may become a member, by a ssh of a few lines."""

from pathlib import Path

import pytest

from dora_systemd.adapters.host.process import OUTPUT_LIMIT
from dora_systemd.decisions.remote.hosts import parse_host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.machines import probe

GPU = parse_host("alice@gpu-box")


def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    program = tmp_path / "ssh"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")


def test_what_it_says_and_how_it_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ssh(tmp_path, monkeypatch, "echo said $1; echo complained >&2; exit 3")
    assert probe._run(GPU, ["x"]) == (3, b"said x\n", b"complained\n")


def test_a_machine_that_never_stops_talking_fills_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flood = f"head -c {4 * OUTPUT_LIMIT} /dev/zero"
    ssh(tmp_path, monkeypatch, f"{flood} >&2; {flood}")
    status, *streams = probe._run(GPU, [])
    assert (status, [len(one) for one in streams]) == (0, [OUTPUT_LIMIT] * 2)


@pytest.mark.parametrize("script", ["exec sleep 100", "exec sleep 100 >&- 2>&-", "exec yes"])
def test_a_machine_that_does_not_end(
    script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ssh(tmp_path, monkeypatch, script)
    with pytest.raises(DoraSystemdError, match="cannot reach alice@gpu-box: no answer") as caught:
        probe._run(GPU, [], 0.2)
    assert caught.value.code is ExitCode.NO_HOST
