"""Speed, latency and memory of the way from the pipes to the journal, without dora."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.system.cells import run

ROOT = Path(__file__).parents[2]
SLACK = int(os.environ.get("DORA_LOG_SLACK", "1"))


# LogRateLimitIntervalSec= works in system scope only.
pytestmark = pytest.mark.lab


def pump(*arguments: str) -> dict[str, Any]:
    """What tests/system/logpump.py prints, run in a unit of its own."""
    unit = ["systemd-run", "--quiet", "--wait", "--pipe", "--collect", "--slice=dora.slice"]
    # 0 would mean journald's own limit, not none: systemd does not pass it on.
    unit += ["--property=LogRateLimitIntervalSec=1s", "--property=LogRateLimitBurst=500000000"]
    unit += [f"--working-directory={ROOT}"]
    module = [sys.executable, "-m", "tests.system.logpump", *arguments]
    result: dict[str, Any] = json.loads(run(*unit, *module).stdout)
    run("journalctl", "--sync")
    return result


def records(uuid: str, node: str) -> list[dict[str, Any]]:
    matches = (f"DORA_DATAFLOW={uuid}", f"DORA_NODE={node}", "DORA_STREAM=stdout")
    done = run("journalctl", "-q", "-o", "json", "--output-fields=MESSAGE", *matches)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_memory_stays_flat() -> None:
    few, many = pump("--lines", "20000"), pump("--lines", "120000")
    assert many["peak_kib"] - few["peak_kib"] < 4096


def test_quiet_node_is_not_kept_waiting() -> None:
    found = pump("--lines", "150000", "--quiet", "200")
    delays = sorted(
        int(record["__REALTIME_TIMESTAMP"]) - int(record["MESSAGE"].split()[1])
        for record in records(found["uuid"], "quiet")
    )
    assert len(delays) == 200
    # The median: on a busy machine with two processors the tail is the scheduler's.
    assert delays[100] < 5000 * SLACK
