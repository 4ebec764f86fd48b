"""What the page shows of limits and switches."""

from typing import Any

import pytest

from dora_systemd.decisions.cell.hot_reload import CHANGE_VARIABLE, HotReload
from dora_systemd.decisions.cell.limits import CHANGES_VARIABLE, parse_node_limits
from dora_systemd.decisions.gateway.page_facts import PROPERTIES, fact_values
from dora_systemd.values import INFINITY
from tests.unit.fakes.manager import options

UNSET = dict.fromkeys(PROPERTIES, INFINITY) | {
    "NoNewPrivileges": True,
    "MemoryDenyWriteExecute": False,
    "PrivateNetwork": False,
    "IPAddressDeny": [],
    "Environment": ["PATH=/bin"],
}


def facts(**unit: Any) -> dict[str, Any]:
    return fact_values(options(), {**UNSET, **unit})


def test_a_dataflow_without_any() -> None:
    assert facts() == {
        "node_limit": [],
        "hot_reload": False,
        "sandbox": "default",
        "network": "host",
    }


def test_limits_are_what_set_takes() -> None:
    found = facts(MemoryMax=4 << 30, CPUQuotaPerSecUSec=1_500_000, MemorySwapMax=0, TasksMax=50)
    assert found["memory_limit"] == "4G"
    assert (found["cpu_limit"], found["tasks_limit"]) == ("150%", "50")
    assert found["swap_limit"] == "0", "no swap at all is a limit"


def test_changes_of_set_take_precedence() -> None:
    own = options(
        node_limits=(parse_node_limits("a:memory=1G,cpu=2"),), reload=HotReload(is_on=True)
    )
    changes = [f"{CHANGES_VARIABLE}=a:memory=2G b:tasks=9 c:tasks=infinity"]
    changes += [f"{CHANGE_VARIABLE}=no"]
    found = fact_values(own, {**UNSET, "Environment": changes})
    assert found["node_limit"] == ["a:cpu=200%,memory=2G", "b:tasks=9"]
    assert found["hot_reload"] is False
    assert fact_values(own, UNSET)["hot_reload"] is True


@pytest.mark.parametrize(
    ("unit", "sandbox", "network"),
    [
        ({"NoNewPrivileges": False}, "none", "host"),
        ({"MemoryDenyWriteExecute": True, "PrivateNetwork": True}, "strict", "private"),
        ({"IPAddressDeny": [(2, b"\0\0\0\0", 0)]}, "default", "loopback"),
    ],
)
def test_sandbox(unit: dict[str, Any], sandbox: str, network: str) -> None:
    found = facts(**unit)
    assert (found["sandbox"], found["network"]) == (sandbox, network)
