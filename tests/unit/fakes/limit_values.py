"""Values that limits can have, for property tests."""

from typing import Any

from hypothesis import strategies as st

from dora_systemd.decisions.cell.limits import BY_WORD, NodeLimits, node_limits
from dora_systemd.values import INFINITY, cpu_bits

MEMORY = st.integers(1 << 20, INFINITY)
CPU = st.integers(100, 10**7).map(lambda hundredths: hundredths * 100) | st.just(INFINITY)
TASKS = st.integers(1, 2**32 - 1) | st.just(INFINITY)
WEIGHT = st.integers(1, 10000)
CPUS = st.sets(st.integers(0, 200), min_size=1).map(cpu_bits) | st.just(INFINITY)
BY_NAME: dict[str, st.SearchStrategy[int]] = {
    "cpu": CPU,
    "memory": MEMORY,
    "memory-high": MEMORY,
    "swap": st.integers(0, INFINITY),
    "tasks": TASKS,
    "cpu-weight": WEIGHT,
    "io-weight": WEIGHT,
    "cpus": CPUS,
}
IDS = st.from_regex(r"(?!\.)[A-Za-z0-9_.-]{1,20}", fullmatch=True)


@st.composite
def limits_of_a_node(draw: st.DrawFn, ids: st.SearchStrategy[str] = IDS) -> NodeLimits:
    """Limits of some node, one at least."""
    words = draw(st.sets(st.sampled_from(sorted(BY_WORD)), min_size=1))
    return node_limits(draw(ids), {word: draw(BY_NAME[word]) for word in words})


_TIME = st.integers(1, 10**12)
_DELAY = st.integers(500_000, 10**12)
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
    "node_limit": st.lists(limits_of_a_node(), unique_by=lambda one: one.node).map(tuple),
    "nice": st.integers(-20, 19),
    "realtime": st.builds("{}:{}".format, st.sampled_from(["rr", "fifo"]), st.integers(1, 99)),
    "device": st.lists(
        st.builds(
            "{} {}".format, st.sampled_from(["/dev/a", "char-b"]), st.sampled_from(["r", "rw"])
        )
    ).map(tuple),
}
