"""CPUs as lists and as bits."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.limits import (
    has_cpus,
    without_cpus,
)
from dora_systemd.decisions.settings.limit_checks import (
    Machine,
    check_cpus,
    needed_controllers,
    size_warnings,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import (
    INFINITY,
    MOST_CPUS,
    cpu_bits,
    cpu_numbers,
    cpus_file,
    format_cpus,
    parse_cpus,
)
from tests.unit.fakes.limit_values import limits_from


@given(st.sets(st.integers(0, MOST_CPUS - 1), min_size=1, max_size=50))
def test_there_and_back(cpus: set[int]) -> None:
    value = cpu_bits(cpus)
    assert cpu_numbers(value) == sorted(cpus)
    assert parse_cpus(format_cpus(value)) == value > INFINITY


def test_a_long_list_is_read_at_once() -> None:
    assert parse_cpus(",".join(["0-8191"] * 100_000)) == parse_cpus("0-8191")  # once took minutes


@pytest.mark.parametrize(
    ("text", "cpus", "formatted"),
    [
        ("3", [3], "3"),
        (" 2-3 ", [2, 3], "2-3"),
        ("4,0, 1-2", [0, 1, 2, 4], "0-2,4"),
        ("0-63", list(range(64)), "0-63"),
        ("infinity", [], "infinity"),
    ],
)
def test_lists(text: str, cpus: list[int], formatted: str) -> None:
    value = parse_cpus(text)
    assert (cpu_numbers(value), format_cpus(value)) == (cpus, formatted)
    assert cpus_file(value) == ("\n" if value == INFINITY else formatted)


@pytest.mark.parametrize("text", ["", "-1", "3-2", "a", "1,", "0-8192", "8192", "1-2-3", "99999"])
def test_bad_lists(text: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot use .* as cpus$") as caught:
        parse_cpus(text)
    assert caught.value.code is ExitCode.USAGE


def test_as_a_limit_of_a_node() -> None:
    limits = limits_from("a:memory_limit=1G,cpus=0,2-3,cpu_limit=1.5")
    assert dict(limits.limits)["cpus"] == cpu_bits([0, 2, 3])
    assert limits.files()["cpuset.cpus"] == "0,2-3"
    assert has_cpus(limits)
    assert without_cpus(limits) == limits_from("a:memory_limit=1G,cpu_limit=1.5")
    assert "cpuset" in needed_controllers({}, [limits])
    lifted = limits_from("a:cpus=infinity")
    assert not has_cpus(lifted)
    assert needed_controllers({}, [lifted]) == {}


def test_cpus_that_the_machine_lacks() -> None:
    machine = Machine(1 << 30, 2, 1000, frozenset({0, 1}))
    limits = [limits_from("a:cpus=1"), limits_from("b:cpus=1-3")]
    with pytest.raises(DoraSystemdError) as caught:
        check_cpus(limits, machine)
    assert caught.value.message == (
        "cannot bind the node b to the cpus 2-3: this machine has none with that number"
    )
    assert (caught.value.hint, caught.value.code) == ("its cpus are 0-1", ExitCode.BAD_INPUT)
    check_cpus(limits, Machine(1 << 30, 2, 1000))
    assert size_warnings({}, limits, machine) == ()
