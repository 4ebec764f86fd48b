"""When a node counts as silent: whole days of a watch, in its own time."""

from collections.abc import Callable, Iterator

import pytest

from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.owes.judge import Judge, Look, Verdict, look
from dora_systemd.decisions.owes.probe import Feeds, find_feeds
from dora_systemd.values import SECOND

HOUR, DAY = 3600 * SECOND, 86400 * SECOND
CAMERA = Owed("camera", "image", 2 * SECOND, 30 * SECOND)
BEGIN = 1000 * SECOND


def always(_: int) -> bool:
    return True


def never(_: int) -> bool:
    return False


class World:
    """A node, a probe and a judge, which runs for as long as told.

    period: µs between two messages; speaks: whether the node sends at that moment. restarts: when
    the node was restarted, which takes `restart_us`. Each of the three stands while it is stopped.
    """

    def __init__(self, *owes: Owed, period: int = SECOND // 30, restart_us: int = SECOND) -> None:
        self.judge = Judge(owes or (CAMERA,))
        self.now = BEGIN
        self.life = BEGIN
        self.beat = 0
        self.heard = 0
        self.period = period
        self.restart_us = restart_us
        self.verdicts: list[Verdict] = []
        self.speaks: Callable[[int], bool] = always
        self.has_probe = True
        self.probe = 1
        self.restarted: list[int] = []
        self.fed: Callable[[int], bool] | None = None
        self.last_fed = 0

    def run(self, duration: int, late: int = 0) -> "World":
        """Everything runs; the judge looks at each tick, and `late` µs after it."""
        end = self.now + duration
        while self.now < end:
            self.now += self.judge.tick + late
            self._live()
            self.look()
        return self

    def _live(self) -> None:
        last = self.now - self.now % self.period
        if last > self.life and self.has_probe and self.speaks(last):
            self.heard = last
        if self.has_probe:
            self.beat = self.now

    def stand(self, duration: int) -> "World":
        """Nothing runs, while the clock does, as with SIGSTOP to all of the cell."""
        self.now += duration
        return self

    def look(self) -> None:
        lives = {"camera": self.life} if self.now >= self.life else {}
        beat = self.beat if self.has_probe else 0
        if self.fed and self.has_probe and self.fed(self.now):
            self.last_fed = self.now
        heard = (self.heard, self.last_fed) if self.fed else (self.heard,)
        now = Look(self.now, beat, heard, lives, self.probe)
        self.judge, found = look(self.judge, now)
        self.verdicts += found
        if any(
            one.is_silent and not one.is_starved and one.owed.then == "restart" for one in found
        ):
            self.restarted.append(self.now)
            self.life = self.now + self.restart_us

    def words(self) -> list[str]:
        return [one.words for one in self.verdicts]


def test_a_day_with_a_silence_in_each_hour() -> None:
    """24 restarts, none missed, none invented, each soon after the time that is allowed."""
    owed = CAMERA._replace(within=8 * SECOND)
    world = World(owed)
    hours = [BEGIN + hour * HOUR + HOUR // 2 for hour in range(24)]

    def speaks(now: int) -> bool:
        begun = [hour for hour in hours if hour <= now]
        return not begun or world.life > begun[-1]

    world.speaks = speaks
    world.run(DAY)
    assert len(world.restarted) == 24
    for at, hour in zip(world.restarted, hours, strict=True):
        assert owed.within < at - hour <= owed.within + 3 * world.judge.tick
    assert [one.is_silent for one in world.verdicts] == 24 * [True, False]
    assert world.words()[:2] == ["no image for 8s", "image again after 2s"]


@pytest.mark.parametrize("period", [SECOND // 1000, SECOND, 1_900_000, 1_999_000])
def test_slow_but_within_is_never_touched(period: int) -> None:
    assert not World(period=period).run(HOUR).verdicts


def test_slower_is_found() -> None:
    assert World(period=3 * SECOND).run(60 * SECOND).restarted


def test_the_first_message_has_its_own_time() -> None:
    world = World(restart_us=SECOND)
    world.speaks = never
    world.run(29 * SECOND)
    assert not world.verdicts
    world.run(3 * SECOND)
    assert world.words() == ["no image within 30s of its start"]
    world.run(10 * SECOND)
    world.speaks = always
    world.run(SECOND)
    assert world.words()[1:] == ["image again after 11s"]


def test_it_is_told_once_until_it_speaks() -> None:
    world = World(CAMERA._replace(then="warn"))
    world.run(10 * SECOND)
    world.speaks = never
    world.run(HOUR)
    assert world.words() == ["no image for 2s"]
    assert world.judge.silent_of("camera") == "no image for 2s"
    world.speaks = always
    world.run(SECOND)
    assert world.words()[1].startswith("image again after 59min 5")
    assert world.judge.silent_of("camera") == ""


def test_a_restart_that_does_not_help_is_followed_by_another() -> None:
    world = World(restart_us=SECOND)
    world.run(10 * SECOND)
    world.speaks = never
    world.run(100 * SECOND)
    assert world.words() == ["no image for 2s", *3 * ["no image within 30s of its start"]]


@pytest.mark.parametrize("period", [SECOND // 30, 1_900_000])
def test_what_stands_is_not_silent(period: int) -> None:
    """SIGSTOP of the whole cell, a machine that was suspended, at any moment and any length."""
    world = World(period=period)
    for number in range(300):
        world.run(SECOND + number * 7919)
        world.stand(number * SECOND // 3)
        # What is stopped sends what was due as soon as it runs.
        world.heard, world.beat = world.now, world.now
        world.look()
    assert not world.verdicts


def test_a_probe_that_stands_hears_nothing() -> None:
    world = World()
    world.run(10 * SECOND)
    world.has_probe = False
    world.run(HOUR)
    assert not world.verdicts
    world.has_probe = True
    world.run(HOUR)
    assert not world.verdicts


@pytest.mark.parametrize("late", [SECOND // 100, SECOND, 20 * SECOND])
def test_a_judge_that_comes_late(late: int) -> None:
    """It invents nothing, and it misses nothing."""
    world = World()
    world.run(600 * SECOND, late=late)
    assert not world.verdicts
    world.speaks = never
    world.run(600 * SECOND, late=late)
    assert world.restarted


def test_a_message_of_the_process_before_counts_for_nothing() -> None:
    world = World(CAMERA._replace(first=5 * SECOND), period=10_000, restart_us=600_000)
    world.run(10 * SECOND)
    life = world.life = world.now + 600_000
    world.speaks = lambda now: now >= life + 4 * SECOND  # slow to start, and then punctual
    world.run(60 * SECOND)
    assert not world.verdicts


def test_the_first_message_may_come_before_the_news_of_its_start() -> None:
    """dora tells the runner some ms later; here it is the only one for a minute."""
    owed = Owed("camera", "image", 60 * SECOND, 5 * SECOND)
    judge, at = Judge((owed,)), BEGIN
    found: tuple[Verdict, ...] = ()
    for _ in range(40):
        at += judge.tick
        judge, new = look(judge, Look(at, at, (BEGIN - 50_000,), {"camera": BEGIN}))
        found += new
    assert not found


def test_several_outputs_of_a_node() -> None:
    owes = (CAMERA._replace(then="warn"), Owed("camera", "depth", SECOND, SECOND, "warn"))

    def looks() -> Iterator[tuple[Judge, tuple[Verdict, ...]]]:
        judge = Judge(owes)
        for number in range(100):
            at = BEGIN + number * judge.tick
            heard = (at if number < 40 else BEGIN + 40 * judge.tick, 0)
            judge, found = look(judge, Look(at, at, heard, {"camera": BEGIN}))
            yield judge, found

    steps = list(looks())
    words = [one.words for _, found in steps for one in found]
    assert words == ["no depth within 1s of its start", "no image for 2s"]
    assert steps[-1][0].silent_of("camera") == "no image for 2s, no depth within 1s of its start"


def test_the_tick_depends_on_the_shortest_time() -> None:
    assert World().judge.tick == SECOND // 4
    assert World(CAMERA._replace(within=HOUR, first=HOUR)).judge.tick == SECOND
    assert World(CAMERA._replace(first=SECOND // 5)).judge.tick == SECOND // 40


@pytest.mark.parametrize("gap", [SECOND // 2, SECOND, 2 * SECOND, 10 * SECOND])
def test_nobody_is_silent_for_what_came_between_two_probes(gap: int) -> None:
    world = World(period=1_900_000)
    for _ in range(40):
        world.run(7 * SECOND + SECOND // 4)
        world.has_probe = False
        world.run(gap)
        world.has_probe, world.probe = True, world.probe + 1
    assert not world.verdicts
    world.speaks = never
    assert world.run(3 * SECOND).words() == ["no image for 2s"]


def fed_world(is_whole: bool = True) -> World:
    """A camera that sends an image for each message of `tick`, while it is well."""
    world = World()
    whole = frozenset({"camera"}) if is_whole else frozenset()
    feeds = Feeds(("camera/image", "tick/t"), {"camera": (1,)}, whole)
    world.judge = Judge((CAMERA,), feeds=feeds)
    world.fed = always
    return world


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_starved_node_is_not_restarted(is_whole: bool) -> None:
    world = fed_world(is_whole).run(60 * SECOND)
    world.fed = world.speaks = never
    world.run(HOUR)
    assert world.words() == ["no image for 2s, starved of tick/t"]
    assert (world.verdicts[0].is_starved, world.restarted) == (True, [])
    # It gets its input again: now it owes an image.
    world.fed = always
    world.run(SECOND)
    assert not world.restarted
    world.run(2 * SECOND)
    assert world.words()[1:] == ["no image for 2s"]
    assert world.restarted
    world.speaks = always
    world.run(3 * SECOND)
    assert world.words()[-1].startswith("image again")


def test_a_node_that_hangs_while_it_is_fed_is_restarted() -> None:
    world = fed_world().run(60 * SECOND)
    world.speaks = never
    world.run(3 * SECOND)
    assert world.words() == ["no image for 2s"]
    assert world.restarted


def test_an_input_that_ended_long_before_is_no_excuse() -> None:
    """Such as a joystick that nobody moves, beside a timer."""
    world = fed_world(is_whole=False).run(60 * SECOND)
    world.fed = never
    world.run(60 * SECOND)
    assert not world.verdicts
    world.speaks = never
    world.run(3 * SECOND)
    assert (world.words(), len(world.restarted)) == (["no image for 2s"], 1)


def test_a_node_that_was_never_fed_is_starved() -> None:
    world = fed_world()
    world.fed = world.speaks = never
    world.run(60 * SECOND)
    assert world.words() == ["no image within 30s of its start, starved of tick/t"]
    assert not world.restarted


def test_which_inputs_are_heard() -> None:
    nodes = [
        {"id": "tick", "path": "a", "outputs": ["t"], "inputs": {"x": "dora/timer/millis/9"}},
        {"id": "far", "path": "a", "outputs": ["t"]},
        {"id": "camera", "path": "a", "outputs": ["image"], "inputs": {"t": "tick/t"}},
        {
            "id": "plan",
            "path": "a",
            "outputs": ["p"],
            "inputs": {"i": "camera/image", "m": "move/m"},
        },
        {"id": "move", "path": "a", "outputs": ["m"], "inputs": {"p": "plan/p", "far": "far/t"}},
    ]
    dataflow = parse_dataflow({"nodes": nodes}, "x.yml")
    owes = tuple(Owed(node, out, SECOND) for node, out in (("camera", "image"), ("plan", "p")))
    feeds = find_feeds((*owes, Owed("move", "m", SECOND)), dataflow, lambda node: node != "far")
    assert feeds.places == ("camera/image", "plan/p", "move/m", "tick/t")
    assert feeds.by_node == {"camera": (3,), "plan": (0,), "move": ()}  # plan and move: a circle
    assert feeds.whole == {"camera"}
