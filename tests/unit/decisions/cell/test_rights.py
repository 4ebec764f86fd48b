"""Rights of single nodes, and the programs that set them."""

import pytest

from dora_systemd.decisions.cell.rights import (
    RAISES,
    Base,
    NodeRights,
    check_rights_nodes,
    described,
    essential_nodes,
    format_commands,
    given_rights,
    has_process_rights,
    limits_of_others,
    rights_commands,
    rights_of,
)
from dora_systemd.decisions.properties.assignments import format_property
from dora_systemd.decisions.settings.resolve import resolve_settings, with_settings
from dora_systemd.decisions.unit.properties import rights_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from tests.unit.fakes.dialogue import OPTIONS
from tests.unit.fakes.manager import with_rights
from tests.unit.fakes.rights_values import rights_from


def test_what_is_given() -> None:
    short = rights_from("camera:essential=yes,scheduling=fifo:07")
    assert short == NodeRights("camera", scheduling="fifo:7", essential=True)
    assert given_rights(rights_from("a:essential=no")) == {"essential": False}


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("a:essentail=yes", "did you mean essential?"),
        *[(f"a:scheduling={one}", "fifo:PRIORITY with 1 to 99") for one in ("fifo", "fifo:0")],
        *[(f"a:scheduling={one}", "fifo:PRIORITY") for one in ("fifo:100", "fifo:-1", "fifo:x")],
        ("a:scheduling=rr:", "rr:PRIORITY with 1 to 99"),
        ("a:scheduling=batsh", "did you mean batch?"),
        ("a:scheduling=batch:5", "did you mean batch?"),
        ("a:scheduling=deadline", "valid values: fifo:PRIORITY, rr:PRIORITY, batch, idle, other"),
        *[(f"a:nice={one}", "from -20") for one in ("20", "-21", "", "x", "1.5", "--1")],
        *[(f"a:oom_score_adjust={one}", "from -1000") for one in ("1001", "-1001", "", "never")],
        ("a:lock_memory=maybe", "yes or no"),
    ],
)
def test_bad_rights(text: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError, match=r"^cannot .*\(--node( a:[a-z_]+)?\)$") as caught:
        resolve_settings({"nodes": (text,)}, {}, ())
    assert hint in caught.value.hint
    assert caught.value.code is ExitCode.USAGE


@pytest.mark.parametrize(
    ("text", "is_raised"),
    [
        *[(f"scheduling={one}", False) for one in ("batch", "idle", "other")],
        *[(f"scheduling={one}", True) for one in ("fifo:1", "rr:99")],
        *[(f"nice={number}", number < 0) for number in (-20, -1, 0, 19)],
        *[(f"oom_score_adjust={number}", number < 0) for number in (-1000, -1, 0, 1000)],
        *[("lock_memory=yes", True), ("lock_memory=no", False), ("essential=yes", False)],
    ],
)
def test_what_only_root_may_give(text: str, is_raised: bool) -> None:
    ((key, value),) = given_rights(rights_from(f"a:{text}")).items()
    assert RAISES[key](value) is is_raised


def test_sources() -> None:
    beside = {
        "nodes": {
            "a": {"scheduling": "rr:5", "essential": True, "memory_limit": "1G"},
            "b": {"memory_limit": "1G"},
            "d": {"nice": 5},
            "c": {"nice": 3, "oom_score_adjust": "-100", "lock_memory": "yes"},
        },
    }
    flags = {"nodes": ("a:scheduling=fifo:9,essential=no", "d:essential=yes")}
    settings = resolve_settings(flags, {}, [("/srv/robot.systemd.yml", beside)])
    assert {*rights_of(with_settings(OPTIONS, settings))} == {
        rights_from("a:scheduling=fifo:9,essential=no"),
        rights_from("c:nice=3,lock_memory=yes,oom_score_adjust=-100"),
        rights_from("d:nice=5,essential=yes"),
    }


def test_questions() -> None:
    rights = [rights_from("a:essential=yes"), rights_from("b:essential=no")]
    assert essential_nodes(with_rights(OPTIONS, *rights)) == ("a",)
    assert not has_process_rights(rights)
    assert has_process_rights([rights_from("a:nice=0")])
    assert [rights_from(f"a:scheduling={s}").priority for s in ("rr:3", "idle")] == [3, 0]


def test_nodes_that_can_have_rights() -> None:
    rights = [rights_from("ros:essential=yes"), rights_from("camera:nice=5")]
    check_rights_nodes(rights, {"camera"})
    with pytest.raises(DoraSystemdError, match="the node 'ros': something else starts it"):
        check_rights_nodes([rights_from("ros:nice=5")], {"camera"})


@pytest.mark.parametrize("key", ["scheduling", "cpus", "lock_memory", "essential"])
def test_keys_for_nodes_only(key: str) -> None:
    with pytest.raises(DoraSystemdError, match=f"unknown key '{key}'"):
        resolve_settings({}, {}, [("/srv/robot.systemd.yml", {key: "no"})])


def test_bad_values_of_nodes_name_file_and_key() -> None:
    document = {"nodes": {"a": {"scheduling": "fifo:100"}}}
    with pytest.raises(DoraSystemdError) as caught:
        resolve_settings({}, {}, [("/srv/robot.systemd.yml", document)])
    assert caught.value.message == (
        "cannot use 'fifo:100' as scheduling (nodes.a.scheduling in /srv/robot.systemd.yml)"
    )
    assert caught.value.code is ExitCode.BAD_INPUT


def commands(*texts: str, base: Base | None = None) -> dict[str, str]:
    """The words of each node without their directory."""
    rights = [rights_from(text) for text in texts]
    found = rights_commands(rights, base or Base())
    return {node: " ".join(words).replace("/usr/bin/", "") for node, words in found.items()}


def granted(*texts: str) -> list[str]:
    properties = rights_properties([rights_from(text) for text in texts])
    return [line for slot in properties for line in format_property(slot, properties)]


def test_nothing_without_rights() -> None:
    assert commands() == {}
    assert commands("a:essential=no", "b:nice=0,oom_score_adjust=0") == {}
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
    assert granted("a:scheduling=idle,nice=5,oom_score_adjust=5,lock_memory=yes") == []


def test_a_nice_value_is_that_of_the_node_and_not_added_to_that_of_the_unit() -> None:
    assert commands("a:nice=5", base=Base(nice=7))["a"] == "nice -n -2"


def test_memory() -> None:
    assert commands("a:lock_memory=yes")["a"] == "prlimit --memlock=unlimited:unlimited"
    assert commands("a:oom_score_adjust=300") == {"a": "choom -n 300 --", "*": ""}


def test_what_is_below_zero_is_for_one_node() -> None:
    """The whole unit has it; the others are raised again."""
    assert granted("a:oom_score_adjust=-500", "b:oom_score_adjust=-9") == ["OOMScoreAdjust=-500"]
    base = Base(oom=-500)
    assert commands("a:oom_score_adjust=-500", "b:nice=1", base=base) == {
        "a": "",
        "b": "choom -n 0 -- nice -n 1",
        "*": "choom -n 0 --",
    }


def test_memory_of_an_essential_node_goes_last() -> None:
    assert commands("a:essential=yes", "b:oom_score_adjust=7") == {
        "a": "",
        "b": "choom -n 7 --",
        "*": "choom -n 500 --",
    }
    in_user_scope = commands("a:essential=yes", base=Base(oom=200))
    assert in_user_scope == {"a": "", "*": "choom -n 700 --"}
    assert commands("a:essential=yes", base=Base(oom=800))["*"] == "choom -n 1000 --"
    both = commands("a:essential=yes", "b:oom_score_adjust=-100", base=Base(oom=-100))
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
    rights = rights_from("a:scheduling=fifo:50,essential=yes,lock_memory=no")
    assert described(rights) == "scheduling fifo:50, no lock_memory, essential"
    assert limits_of_others([rights]) == {"rtprio": 0}
