"""Sequences of steps from a seed. Pure: the same seed gives the same steps, on every machine."""

from random import Random

from tests.history.steps import CELLS, COMMANDS, FAULTS, LOOK, Step, Wish

LOOK_EVERY = 6
COMMAND_SHARE = 0.6
JOINED_SHARE = 0.35
START_SHARE = 0.7
"""Of the steps about a dataflow that does not run: those that start it."""
PAUSES_MS = (0, 0, 0, 50, 200, 600, 1500)


def generate(seed: int, count: int) -> list[Step]:
    """`count` steps, the looks among them not counted; the first starts a dataflow."""
    random, up = Random(seed), {CELLS[0]}
    steps = [Step("start"), Step(LOOK)]
    for number in range(1, count):
        steps.append(_step(random, up, is_alone=steps[-1].what == LOOK))
        if number % LOOK_EVERY == 0:
            steps.append(Step(LOOK))
    return steps if steps[-1].what == LOOK else [*steps, Step(LOOK)]


def _step(random: Random, up: set[str], is_alone: bool) -> Step:
    """up: the cells that should run if all goes well; a fault needs something to hit."""
    cell = random.choices(CELLS, (3, 1))[0]
    what = _command(random) if random.random() < COMMAND_SHARE else _fault(random)
    if cell not in up and random.random() < START_SHARE:
        what = "start"
    _note_wish(what, cell, up)
    is_joined = random.random() < JOINED_SHARE and not is_alone
    return Step(what, cell, random.choice(PAUSES_MS), is_joined)


def _note_wish(what: str, cell: str, up: set[str]) -> None:
    command = COMMANDS.get(what)
    if command and command.wish is Wish.RUN:
        up.add(cell)
    elif command and command.wish is Wish.STOP:
        up -= set(CELLS) if command.is_for_all else {cell}


def _command(random: Random) -> str:
    return random.choices(list(COMMANDS), [one.weight for one in COMMANDS.values()])[0]


def _fault(random: Random) -> str:
    return random.choices(list(FAULTS), [one.weight for one in FAULTS.values()])[0]
