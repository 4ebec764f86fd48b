"""Values that limits can have, for property tests."""

from typing import Any

from hypothesis import strategies as st

from dora_systemd.decisions.cell.limits import NodeLimits, node_limits
from dora_systemd.decisions.settings.table import NODES
from dora_systemd.values import INFINITY, cpu_bits

MEMORY = st.integers(1 << 20, INFINITY)
CPU = st.integers(100, 10**7).map(lambda hundredths: hundredths * 100) | st.just(INFINITY)
TASKS = st.integers(1, 2**32 - 1) | st.just(INFINITY)
WEIGHT = st.integers(1, 10000)
CPUS = st.sets(st.integers(0, 200), min_size=1).map(cpu_bits) | st.just(INFINITY)
IDS = st.from_regex(r"(?!\.)[A-Za-z0-9_.-]{1,20}", fullmatch=True)


def limits_from(text: str) -> NodeLimits:
    """The limits of a node, as --node takes them."""
    ((node, values),) = NODES.kind.parse([text], None).items()
    return node_limits(node, values)


_TIME = st.integers(1, 10**12)
_DELAY = st.integers(0, 10**12)
RESTART_VALUES: dict[str, st.SearchStrategy[Any]] = {
    "restart_policy": st.sampled_from(["no", "on-failure", "always"]),
    "max_restarts": st.integers(1, 1_000_000) | st.just(INFINITY),
    "restart_window": _TIME,
    "restart_delay": _DELAY,
    "max_restart_delay": _DELAY,
    "start_timeout": _TIME,
}

LIMIT_VALUES: dict[str, st.SearchStrategy[Any]] = {
    "cpu_limit": CPU,
    "memory_limit": MEMORY,
    "memory_high": MEMORY,
    "swap_limit": st.integers(0, INFINITY),
    "tasks_limit": TASKS,
    "cpu_weight": WEIGHT,
    "io_weight": WEIGHT,
    "cpus": CPUS,
    "nice": st.integers(-20, 19),
    "realtime": st.builds("{}:{}".format, st.sampled_from(["rr", "fifo"]), st.integers(1, 99)),
    "device": st.lists(
        st.builds(
            "{} {}".format, st.sampled_from(["/dev/a", "char-b"]), st.sampled_from(["r", "rw"])
        )
    ).map(tuple),
}
