"""Sequences of steps from a seed. Pure: the same seed gives the same steps, on every machine."""

from collections.abc import Mapping
from random import Random

from tests.history.steps import ALONE, CELLS, COMMANDS, FAULTS, LOOK, Command, Fault, Step, Wish

LOOK_EVERY = 6
COMMAND_SHARE = 0.6
JOINED_SHARE = 0.35
START_SHARE = 0.7
"""Of the steps about a dataflow that does not run: those that start it."""
ANSWERED_SHARE = 0.4
"""Of the steps after a fault: those that meet the dataflow while it is not what it was."""
AFTER_FAULTS = ("stop", "stop", "restart", "start", "systemctl-stop", "reload", "enable", "destroy")
HIT_SHARE = 0.1
"""Of the steps after a command: those that hit doractl while it runs."""
IN_COMMANDS = ("kill-doractl", "kill-doractl", "stop-doractl", "daemon-reexec")
SOON_MS = (0, 30, 100, 300, 700)
PAUSES_MS = (0, 0, 0, 50, 200, 600, 1500)


def generate(seed: int, count: int, lab: str = ALONE) -> list[Step]:
    """`count` steps, the looks among them not counted; the first starts a dataflow.

    lab: where it will happen, one of LABS.
    """
    random, up = Random(seed), {CELLS[0]}
    commands = {name: one for name, one in COMMANDS.items() if lab in one.labs}
    faults = {name: one for name, one in FAULTS.items() if lab in one.labs}
    steps = [Step("start"), Step(LOOK)]
    for number in range(1, count):
        steps.append(_step(random, up, steps[-1], commands, faults))
        if number % LOOK_EVERY == 0:
            steps.append(Step(LOOK))
    return steps if steps[-1].what == LOOK else [*steps, Step(LOOK)]


def _step(
    random: Random,
    up: set[str],
    before: Step,
    commands: Mapping[str, Command],
    faults: Mapping[str, Fault],
) -> Step:
    """up: the cells that should run if all goes well; a fault needs something to hit."""
    if before.what in FAULTS and random.random() < ANSWERED_SHARE:
        what = random.choice(AFTER_FAULTS)
        _note_wish(what, before.cell, up)
        return Step(what, before.cell, random.choice(SOON_MS), random.random() < JOINED_SHARE)
    if before.what in COMMANDS and random.random() < HIT_SHARE:
        return Step(random.choice(IN_COMMANDS), before.cell, random.choice(SOON_MS), is_joined=True)
    cell = random.choices(CELLS, (3, 1))[0]
    what = _drawn(random, commands if random.random() < COMMAND_SHARE else faults)
    if cell not in up and random.random() < START_SHARE:
        what = "start"
    _note_wish(what, cell, up)
    is_joined = random.random() < JOINED_SHARE and before.what != LOOK
    return Step(what, cell, random.choice(PAUSES_MS), is_joined)


def _note_wish(what: str, cell: str, up: set[str]) -> None:
    command = COMMANDS.get(what)
    if command and command.wish is Wish.RUN:
        up.add(cell)
    elif command and command.wish is Wish.STOP:
        up -= set(CELLS) if command.is_for_all else {cell}


def _drawn(random: Random, some: Mapping[str, Command] | Mapping[str, Fault]) -> str:
    return random.choices(list(some), [one.weight for one in some.values()])[0]
