"""The figures of many histories. Pure."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from tests.history.checker import Complaint
from tests.history.history import History, Vital
from tests.history.lives import vital_series
from tests.history.steps import FAULTS


class Report:
    """What was done in all histories so far."""

    def __init__(self) -> None:
        self.steps: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()
        self.complaints: Counter[str] = Counter()
        self.lines = 0
        self.looks = 0
        self.seeds: list[int] = []
        self.ends: dict[str, tuple[Vital, Vital]] = {}
        self.growth: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)

    def add(self, seed: int, history: History, complaints: Sequence[Complaint]) -> None:
        """Count one more history."""
        self.seeds.append(seed)
        for answer in history.answers:
            is_missed = answer.step.what in FAULTS and answer.status != 0
            (self.missed if is_missed else self.steps)[answer.step.what] += 1
        self.lines += len(history.lines)
        self.looks += len(history.looks)
        self.complaints.update(one.invariant for one in complaints)
        for name, series in vital_series(history).items():
            first, last = series[min(1, len(series) - 1)], series[-1]
            grown = last.anonymous - first.anonymous, last.descriptors - first.descriptors
            self.growth[name.partition(" (")[0]].append(grown)
            self.ends[name] = self.ends.get(name, (first, last))[0], last

    def line_of(self, seed: int, history: History, complaints: Sequence[Complaint]) -> str:
        """What came of one seed."""
        paces = [look.pace for look in history.looks]
        head = (
            f"seed {seed}: {len(history.answers)} steps, {len(history.looks)} looks, "
            f"{len(history.lines)} lines, pace {max(paces, default=0):.1f}, "
            f"{len(complaints)} complaints"
        )
        return "\n".join([head, *(f"  {one.invariant}: {one.text}" for one in complaints)])

    def format(self) -> str:
        """All figures."""
        rows = [f"{what:20} {count:5}" for what, count in sorted(self.steps.items())]
        missed = [f"{what:20} {count:5} without a target" for what, count in self.missed.items()]
        return "\n".join([
            f"seeds {self.seeds}",
            f"steps {self.steps.total()}, looks {self.looks}, lines checked {self.lines}",
            *rows,
            *missed,
            *(f"{name}: most growth {self._most(name)}" for name in sorted(self.growth)),
            *(f"{name} over all: {self._drift(name)}" for name in self._lasting()),
            f"complaints {dict(self.complaints)}",
        ])  # fmt: skip

    def _lasting(self) -> list[str]:
        return [name for name in self.ends if not name.startswith("runner")]

    def _drift(self, name: str) -> str:
        """What a process that outlives histories held at the first and at the last look."""
        first, last = self.ends[name]
        memory = f"{first.anonymous} to {last.anonymous} KiB"
        return f"{memory}, {first.descriptors} to {last.descriptors} descriptors"

    def _most(self, name: str) -> str:
        memory, descriptors = (max(column) for column in zip(*self.growth[name], strict=True))
        return f"{memory} KiB, {descriptors} descriptors"
