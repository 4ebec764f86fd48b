"""What is advised: within 25 % of the truth of synthetic lives, silent on little, with evidence."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dora_systemd.decisions.advice.evidence import Recorded, collect
from dora_systemd.decisions.advice.report import AdviceReport, format_report, report_object
from dora_systemd.decisions.advice.rules import Advice, Current, advise, too_little
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.restarts import RestartPolicy
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.logs.journal_events import NODE_FAILURES
from dora_systemd.decisions.views.formats import zoned_time
from dora_systemd.decisions.why.lives import Happening, Life
from dora_systemd.values import INFINITY, SECOND, parse_cpu, parse_duration, parse_size
from tests.unit.decisions.advice.synthetic import BEGIN, Limits, Truth, event, lives_of

MIB = 1 << 20
PARSE: dict[str, Callable[[str], int]] = {
    "memory_limit": parse_size,
    "cpu_limit": parse_cpu,
    "stop.within": parse_duration,
    "owes.image.within": parse_duration,
}


def current(limits: Limits) -> Current:
    """The settings of the only node, as the dataflow has them."""
    owes = (Owed("camera", "image", limits.within, then="warn"),) if limits.within else ()
    return Current(
        frozenset({"camera"}),
        {"camera": limits.memory},
        {"camera": limits.cpu},
        stops={"camera": NodeStop("camera", limits.stop)},
        owes=owes,
    )


def advised(lives: Sequence[Life], limits: Limits) -> dict[str, Advice]:
    return {one.setting: one for one in advise(collect(lives, {}), current(limits))}


def values(advices: dict[str, Advice]) -> dict[str, int]:
    return {key: PARSE[key](one.value) for key, one in advices.items()}


TRUTHS = st.builds(
    Truth,
    memory=st.integers(20 * MIB, 64 << 30),
    cpu=st.integers(SECOND // 4, 16 * SECOND),
    stop=st.integers(SECOND // 2, 200 * SECOND),
    jitter=st.integers(SECOND, 60 * SECOND),
)


@given(TRUTHS, st.integers(3, 8), st.integers(0, 1000))
@settings(deadline=None, max_examples=40)
def test_what_was_seen_is_advised_within_a_quarter(truth: Truth, count: int, seed: int) -> None:
    """Limits that are too close, or far off, or missing, but hide nothing."""
    limits = Limits(
        cpu=int(truth.cpu * 1.01), stop=int(truth.stop * 1.02), within=int(truth.jitter * 0.4)
    )
    found = values(advised(lives_of(truth, limits, count, seed=seed), limits))
    truths = {
        "memory_limit": truth.memory,
        "cpu_limit": truth.cpu,
        "stop.within": truth.stop,
        "owes.image.within": truth.jitter,
    }
    assert found.keys() == truths.keys()
    for key, value in truths.items():
        assert value <= found[key] <= 1.25 * value, key
    for close in (1.05, 3.0):
        limits = Limits(int(truth.memory * close), 2 * truth.cpu, 2 * truth.stop)
        found = values(advised(lives_of(truth, limits, count, seed=seed), limits))
        assert found.keys() == {"memory_limit"}
        assert truth.memory <= found["memory_limit"] <= 1.25 * truth.memory


@given(TRUTHS, st.floats(0.2, 0.99), st.integers(0, 1000))
@settings(deadline=None, max_examples=15)
def test_what_a_limit_hides_is_found_step_by_step(truth: Truth, share: float, seed: int) -> None:
    """Whoever follows the advices soon has limits that suffice, and none far above."""
    truth = replace(truth, jitter=0)
    limits = Limits(
        max(int(truth.memory * share), 2 * MIB),
        max(int(truth.cpu * share), SECOND // 50),
        max(int(truth.stop * share), SECOND // 20),
    )
    lives: list[Life] = []
    for _ in range(16):
        lives += lives_of(truth, limits, 3, len(lives), seed)
        found = advised(lives, limits)
        if not found:
            break
        now = values(found)
        limits = Limits(
            now.get("memory_limit", limits.memory),
            now.get("cpu_limit", limits.cpu),
            now.get("stop.within", limits.stop),
        )
    assert not found
    for have, need in zip(
        (limits.memory, limits.cpu, limits.stop), (truth.memory, truth.cpu, truth.stop), strict=True
    ):
        assert need <= have <= 1.6 * need
    last = lives_of(truth, limits, 1, len(lives), seed)[0]
    assert not last.all(*NODE_FAILURES, "cpu-throttled", "node-stop-late")


@pytest.mark.parametrize(
    ("lives", "seconds", "words"),
    [
        (0, 0, "too little is recorded: 0 lives, 0 s"),
        (1, 9000, "too little is recorded: 1 life, 2 h"),
        (2, 120, "too little is recorded: 2 lives, 4 min"),
        (3, 199, "too little is recorded: 3 lives, 9 min"),
        (3, 200, ""),
    ],
)
def test_silence_on_little(lives: int, seconds: int, words: str) -> None:
    many = [quiet(number, seconds) for number in range(lives)]
    recorded = collect(many, {})
    assert too_little(recorded) == words
    found = advise(recorded, current(Limits()))
    assert bool(found) == (not words)


def quiet(number: int, seconds: int, *more: Happening) -> Life:
    """A life of a node that holds 100 M."""
    begin = moment(number)
    end = begin + seconds * SECOND
    return Life(
        (
            event("dataflow-starting", begin - SECOND, ""),
            event("node-ready", begin),
            event("dataflow-started", begin, ""),
            *more,
            event("node-exited", end, held_peak=100 * MIB),
            event("dataflow-stopped", end, "", held_peak=100 * MIB),
        )
    )


def moment(number: int, seconds: float = 0) -> int:
    return BEGIN + number * 86400 * SECOND + int(seconds * SECOND)


def recorded(*happened: Sequence[Happening], seconds: int = 7200) -> Recorded:
    """Three lives, the first ones with these events."""
    padded = [*happened, (), (), ()][: max(3, len(happened))]
    return collect([quiet(n, seconds, *more) for n, more in enumerate(padded)], {})


def only(found: Sequence[Advice]) -> Advice:
    (one,) = [one for one in found if one.setting != "memory_limit"]
    return one


def test_a_failed_start_is_no_life() -> None:
    failed = Life((event("dataflow-starting", 1, ""), event("dataflow-failed", 2, "")))
    assert collect([failed, quiet(0, 60), failed], {}).lives == 1


def test_a_life_that_goes_on_counts_until_now() -> None:
    going = Life(quiet(0, 60).happenings[:3])
    assert collect([going], {}, moment(0, 100)).duration_us == 100 * SECOND
    assert collect([going], {}).duration_us == 0


def node(**more: Any) -> Current:
    return replace(Current(frozenset({"camera"}), {"camera": 120 * MIB}), **more)


def test_memory_has_its_evidence() -> None:
    kills = [
        event("node-oom", moment(0, n), owner="node", limit=100 * MIB, exit="x") for n in (5, 9)
    ]
    (found,) = advise(recorded(kills), node(memory={"camera": 100 * MIB}))
    assert found == Advice(
        *("camera", ("memory_limit",), "100M", "152M", True),
        "reached its limit of 100M 2 times",
        found.seen,
    )
    assert found.place == ("nodes", "camera", "memory_limit")
    assert [one.at_us for one in found.seen] == [moment(0, 5), moment(0, 9)]
    assert advise(recorded(kills), node(memory={"camera": 150 * MIB})) == [], "it has been raised"


@pytest.mark.parametrize(
    ("mapped", "now", "value"),
    [(110, INFINITY, "122M"), (300, INFINITY, "336M"), (300, 105, "336M"), (300, 600, None)],
)
def test_an_advice_is_not_below_what_is_mapped(mapped: int, now: int, value: str | None) -> None:
    ended = event("node-exited", moment(0, 5), mapped_peak=mapped * MIB)
    memory = {"camera": now * MIB if now < INFINITY else INFINITY}
    found = advise(recorded([ended]), node(memory=memory))
    assert [one.value for one in found] == ([value] if value else [])
    for one in found:
        assert one.why == f"held at most 100M, {mapped}M with mapped files"


def test_mapped_files_fill_a_limit_and_need_no_more() -> None:
    ended = event("node-exited", moment(0, 5), mapped_peak=150 * MIB)
    assert advise(recorded([ended]), node(memory={"camera": 150 * MIB})) == []


@pytest.mark.parametrize("owner", ["machine", "dataflow"])
def test_another_limit_hides_nothing(owner: str) -> None:
    kill = event("node-oom", moment(0, 5), owner=owner, limit=100 * MIB)
    assert advise(recorded([kill]), node()) == []


def test_waiting_for_memory_is_a_limit_that_was_reached() -> None:
    wait = event("memory-pressure", moment(0, 5), held=50 * MIB, limit=120 * MIB, stalled=40)
    (found,) = advise(recorded([wait]), node())
    assert (found.is_least, found.value) == (True, "180M")
    full = event("memory-pressure", moment(0, 5), held=119 * MIB, limit=120 * MIB, stalled=40)
    (found,) = advise(recorded([full]), node())
    assert (found.is_least, found.value) == (False, "144M")


def test_all_nodes_together() -> None:
    kill = event("dataflow-oom", moment(0, 5), "", limit=1 << 30)
    (found,) = advise(recorded([kill]), node(memory={"camera": 120 * MIB, "": 1 << 30}))
    assert (found.place, found.value) == (("memory_limit",), "1536M")
    assert "all nodes together: memory_limit 1536M, or more" in format_report(report([found]))
    assert advise(recorded(), node(memory={"camera": 120 * MIB})) == [], "no limit for its own sake"


def test_no_more_than_the_machine_has() -> None:
    kill = event("node-oom", moment(0, 5), owner="node", limit=100 * MIB)
    assert advise(recorded([kill]), node(machine_memory=140 * MIB)) == []
    slow = [event("cpu-throttled", moment(0, 5), cpu_limit=150)]
    few = node(cpu={"camera": 1_500_000}, processors=2)
    assert only(advise(recorded(slow), few)).value == "200%"
    assert advise(recorded(slow), node(cpu={"camera": 2_000_000}, processors=2)) == []


def test_without_a_cpu_limit_none_is_advised() -> None:
    assert advise(recorded([event("cpu-throttled", moment(0, 5), cpu_limit=150)]), node()) == []


def policies(policy: str = "on-failure", most: int = 5) -> Current:
    return node(policies={"camera": RestartPolicy(policy, most)})


def test_restarts_for_a_node_that_runs_well_before_it_fails() -> None:
    crash = partial(event, "node-crashed")
    fails = [[crash(moment(n, 600))] for n in range(2)]
    found = only(advise(recorded(*fails), policies("no")))
    assert (found.key, found.now, found.value) == (("restart_policy",), "no", "on-failure")
    assert found.why == "failed 2 times after 10 min or more, and stayed down"
    assert advise(recorded(*fails), policies()) == []
    assert advise(recorded(fails[0]), policies("no")) == [], "once"
    at_once = [[crash(moment(n, 2))] for n in range(3)]
    assert advise(recorded(*at_once), policies("no")) == [], "a restart does not mend it"
    restarted = [*fails[0], event("node-restarted", moment(0, 601))]
    assert advise(recorded(restarted, fails[1]), policies("no")) == [], "another policy counts"
    assert advise(recorded(*fails), node()) == [], "the descriptor has a policy"


def storm(count: int, begin: float = 10, gap: float = 5) -> list[Happening]:
    """Crashes and restarts."""
    times = [begin + gap * n for n in range(count)]
    return [
        event(name, moment(0, at + more))
        for at in times
        for name, more in (("node-crashed", 0), ("node-restarted", 1), ("node-ready", 2))
    ]


@pytest.mark.parametrize(
    ("count", "most", "value"),
    [(3, 5, ""), (4, 5, ""), (5, 5, "6"), (10, 10, "12"), (10, 12, ""), (5, INFINITY, "")],
)
def test_the_number_of_restarts(count: int, most: int, value: str) -> None:
    found = advise(recorded(storm(count)), policies(most=most))
    assert [one.value for one in found] == ([value] if value else [])


def test_restarts_that_did_not_help_are_no_reason_for_more() -> None:
    gone = [*storm(5), event("node-crashed", moment(0, 60))]
    assert advise(recorded(gone), policies()) == []
    apart = storm(5, gap=1000)
    assert advise(recorded(apart), policies()) == [], "one in a window"
    (found,) = advise(recorded(storm(5)), policies())
    assert found.why == "recovered after 5 restarts within 10min, of 5 it has"
    assert found.place == ("nodes", "camera", "max_restarts")


def stop(seconds: float, *more: Happening, exit: str = "") -> Life:
    whole = quiet(0, 7200)
    begin = moment(0, 7000)
    return Life(
        (
            *whole.happenings[:3],
            event("dataflow-stopping", begin, ""),
            *more,
            event("node-exited", begin + int(seconds * SECOND), exit=exit, held_peak=100 * MIB),
            whole.happenings[-1],
        )
    )


@pytest.mark.parametrize(
    ("life", "value", "words"),
    [
        (stop(2), "", ""),
        (stop(9.5), "11s 400ms", "took up to 9s 500ms to stop"),
        (stop(15, exit="signal SIGKILL"), "22s 500ms", "had not stopped after 15s once"),
        (
            stop(12, event("node-stop-late", moment(0, 7010))),
            "15s",
            "had not stopped after 10s once",
        ),
    ],
)
def test_the_time_to_stop(life: Life, value: str, words: str) -> None:
    found = advise(collect([life, quiet(1, 60), quiet(2, 60)], {}), node())
    assert [(one.setting, one.value, one.why) for one in found] == (
        [("stop.within", value, words)] if value else []
    )
    assert advise(collect([life, life, life], {}), node(stop_limit=11 * SECOND)) == []


def test_a_stop_begins_when_those_before_have_ended() -> None:
    other = event("node-exited", moment(0, 7008), "arm")
    life = stop(10, other)
    (found,) = advise(collect([life] * 3, {}), node())
    assert found.setting == "stop.within"
    assert advise(collect([life] * 3, {"camera": ("arm", "gone")}), node()) == []


def silences(*lasted: float, reason: str = "no image for 2s") -> list[Happening]:
    found = []
    for number, seconds in enumerate(lasted):
        at = 100.0 * number
        found += [
            event("node-silent", moment(0, at), output="image", reason=reason),
            event("node-speaks-again", moment(0, at + seconds - 2), output="image"),
        ]
    return found


OWED = node(owes=(Owed("camera", "image", 2 * SECOND, then="warn"), Owed("x", "image", 2 * SECOND)))


def test_an_output_that_comes_late_again_and_again() -> None:
    found = only(advise(recorded(silences(2.5, 4, 3, 600)), OWED))
    assert (found.place, found.now) == (("nodes", "camera", "owes", "image", "within"), "2s")
    assert found.value == "4s 800ms"
    assert found.why == "image came again by itself 3 times, after up to 4s"
    assert advise(recorded(silences(2.5, 4, 600)), OWED) == [], "an outage is no slow output"


@pytest.mark.parametrize(
    "reason",
    [
        "no image within 30s of its start",
        "no image for 2s, starved of lidar/points",
        "no image for ever",
        "no image for infinity",
        "",
    ],
)
def test_silences_that_do_not_count(reason: str) -> None:
    assert advise(recorded(silences(2.5, 4, 3, reason=reason)), OWED) == []


def test_a_silence_that_a_restart_ended() -> None:
    broken = silences(2.5, 4, 3)
    for place in (1, 3, 5):
        broken.insert(place, event("node-ended", broken[place - 1].at_us))
    assert advise(recorded(broken), OWED) == []


@pytest.mark.parametrize("text", ["-5", "²", "9" * 300, "", "1e9", "0"])
def test_records_that_a_node_has_forged(text: str) -> None:
    forged = [
        event("node-exited", moment(0, 1), held_peak=text, cpu_peak=text),
        event("node-oom", moment(0, 1), owner="node", limit=text),
        event("memory-pressure", moment(0, 1), held=text, limit=text, stalled=text),
        event("cpu-throttled", moment(0, 1), cpu_limit=text),
        event("node-exited", moment(0, 1), "../etc", held_peak=1 << 40),
        event("node-exited", moment(0, 1), "stranger", held_peak=1 << 40),
    ]
    assert advise(recorded(forged), node()) == []


def report(
    advices: Sequence[Advice], file: str = "/srv/robot/dataflow.systemd.yml"
) -> AdviceReport:
    return AdviceReport("robot", "uuid", recorded(), advices, file)


def test_what_a_person_reads() -> None:
    advices = advise(recorded(), Current(frozenset({"camera"})))
    assert format_report(report(advices)).splitlines() == [
        "robot: 3 lives, 6 h",
        "",
        "camera: memory_limit 120M (now none)",
        f"  held at most 100M, in 3 of 3 lives, last {zoned_time(moment(2, 7200))}",
        "",
        "Into /srv/robot/dataflow.systemd.yml: doractl advise robot --apply",
    ]
    done = format_report(replace(report(advices), is_applied=True)).splitlines()
    assert done[-1] == "Settings changed: /srv/robot/dataflow.systemd.yml; the next start has them"
    assert format_report(report([])) == "robot: nothing to change, after 3 lives, 6 h"
    assert "--apply" not in format_report(report(advices, ""))
    little = replace(report([]), recorded=collect([], {}))
    assert format_report(little) == "robot: too little is recorded: 0 lives, 0 s"


def test_what_a_program_reads() -> None:
    advices = advise(recorded(), Current(frozenset({"camera"})))
    found = report_object(report(advices))
    (one,) = found["advice"]
    assert found["too_little"] is None
    assert (one["node"], one["setting"], one["now"], one["value"]) == (
        *("camera", "memory_limit", None, "120M"),
    )
    assert (one["seen"], one["count"], one["lives"]) == (100 * MIB, 3, 3)
    assert one["last_us"] == moment(2, 7200)
