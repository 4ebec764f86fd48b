"""Speed, latency and memory of the way from the pipes to the journal, without dora."""

import json
import sys
from bisect import bisect
from pathlib import Path
from typing import Any

import pytest

from tests.system.cells import run, sync_journal

ROOT = Path(__file__).parents[2]


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
    sync_journal()
    return result


def records(uuid: str, node: str) -> list[tuple[int, str]]:
    """A node's lines, each with the time at which journald took it, in microseconds."""
    matches = (f"DORA_DATAFLOW={uuid}", f"DORA_NODE={node}", "DORA_STREAM=stdout")
    done = run("journalctl", "-q", "-o", "json", "--output-fields=MESSAGE", *matches)
    found = map(json.loads, done.stdout.splitlines())
    return [(int(one["__REALTIME_TIMESTAMP"]), one["MESSAGE"]) for one in found]


def test_memory_stays_flat() -> None:
    few, many = pump("--lines", "20000"), pump("--lines", "120000")
    assert many["peak_kib"] - few["peak_kib"] < 4096


def test_quiet_node_is_not_kept_waiting() -> None:
    found = pump("--lines", "150000", "--quiet", "200")
    flood = [arrived for arrived, _ in records(found["uuid"], "n0")]
    quiet = records(found["uuid"], "quiet")
    # Lines of the flood that journald took while a line of the quiet node was on its way: time
    # would depend on how busy the machine is.
    before = [
        bisect(flood, arrived) - bisect(flood, int(text.split()[1])) for arrived, text in quiet
    ]
    assert len(before) == 200
    assert sorted(before)[100] < 200
