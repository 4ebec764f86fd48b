"""The programs in front of a node's program, and what the unit has to grant for them."""

from dora_systemd.decisions.properties.assignments import format_property
from dora_systemd.decisions.rights.commands import (
    Base,
    described,
    format_commands,
    limits_of_others,
    rights_commands,
)
from dora_systemd.decisions.rights.node_rights import parse_node_rights
from dora_systemd.decisions.unit.properties import rights_properties


def commands(*texts: str, base: Base | None = None) -> dict[str, str]:
    """The words of each node without their directory."""
    rights = [parse_node_rights(text) for text in texts]
    found = rights_commands(rights, base or Base())
    return {node: " ".join(words).replace("/usr/bin/", "") for node, words in found.items()}


def granted(*texts: str) -> list[str]:
    properties = rights_properties([parse_node_rights(text) for text in texts])
    return [line for slot in properties for line in format_property(slot, properties)]


def test_nothing_without_rights() -> None:
    assert commands() == {}
    assert commands("a:essential=no", "b:nice=0,oom-score-adjust=0") == {}
    assert granted() == []


def test_realtime_is_for_one_node() -> None:
    assert commands("a:scheduling=fifo:50", "b:nice=5") == {
        "a": "prlimit --rtprio=50:50 chrt --fifo 50",
        "b": "prlimit --rtprio=0:0 nice -n 5",
        "*": "prlimit --rtprio=0:0",
    }
    assert granted("a:scheduling=fifo:50", "b:scheduling=rr:70", "c:nice=5") == ["LimitRTPRIO=70"]


def test_priority_of_the_usual_kind() -> None:
    assert commands("a:nice=-5", "b:nice=3") == {
        "a": "prlimit --nice=25:25 nice -n -5",
        "b": "prlimit --nice=0:0 nice -n 3",
        "*": "prlimit --nice=0:0",
    }
    assert granted("a:nice=-5", "b:nice=-20") == ["LimitNICE=40"]
    assert commands("a:scheduling=idle") == {"a": "chrt --idle 0", "*": ""}
    assert granted("a:scheduling=idle,nice=5,oom-score-adjust=5,lock-memory") == []


def test_a_nice_value_is_that_of_the_node_and_not_added_to_that_of_the_unit() -> None:
    assert commands("a:nice=5", base=Base(nice=7))["a"] == "nice -n -2"


def test_memory() -> None:
    assert commands("a:lock-memory")["a"] == "prlimit --memlock=unlimited:unlimited"
    assert commands("a:oom-score-adjust=300") == {"a": "choom -n 300 --", "*": ""}


def test_what_is_below_zero_is_for_one_node() -> None:
    """The whole unit has it; the others are raised again."""
    assert granted("a:oom-score-adjust=-500", "b:oom-score-adjust=-9") == ["OOMScoreAdjust=-500"]
    base = Base(oom=-500)
    assert commands("a:oom-score-adjust=-500", "b:nice=1", base=base) == {
        "a": "",
        "b": "choom -n 0 -- nice -n 1",
        "*": "choom -n 0 --",
    }


def test_memory_of_an_essential_node_goes_last() -> None:
    assert commands("a:essential", "b:oom-score-adjust=7") == {
        "a": "",
        "b": "choom -n 7 --",
        "*": "choom -n 500 --",
    }
    in_user_scope = commands("a:essential", base=Base(oom=200))
    assert in_user_scope == {"a": "", "*": "choom -n 700 --"}
    assert commands("a:essential", base=Base(oom=800))["*"] == "choom -n 1000 --"
    both = commands("a:essential", "b:oom-score-adjust=-100", base=Base(oom=-100))
    assert both == {"a": "choom -n 0 --", "b": "", "*": "choom -n 500 --"}


def test_cpus_without_a_cpuset() -> None:
    base = Base(bound={"b": "2-3", "a": "0"})
    assert commands("a:scheduling=rr:1", base=base) == {
        "a": "prlimit --rtprio=1:1 taskset -c 0 chrt --rr 1",
        "b": "prlimit --rtprio=0:0 taskset -c 2-3",
        "*": "prlimit --rtprio=0:0",
    }


def test_lines_of_the_launcher() -> None:
    assert format_commands({"a": ["/usr/bin/nice", "-n", "5"], "*": []}) == (
        "a /usr/bin/nice -n 5\n* \n"
    )


def test_words_for_messages() -> None:
    rights = parse_node_rights("a:scheduling=fifo:50,essential,lock-memory=no")
    assert described(rights) == "scheduling fifo:50, no lock_memory, essential"
    assert limits_of_others([rights]) == {"rtprio": 0}
