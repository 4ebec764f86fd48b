"""After a test in which nothing breaks: no unexpected warning in the journal of any machine."""

import shlex
from collections.abc import Iterator
from functools import partial

import pytest

from tests.machines.wires import OTHERS, there
from tests.system.complaints import Journalctl, complaints, end_of_journal, journalctl


def _journalctl(machine: str, *words: str) -> str:
    return there(machine, shlex.join(("journalctl", *words))).stdout


@pytest.fixture
def quiet_journals(request: pytest.FixtureRequest) -> Iterator[None]:
    """Comes before the dataflow, and looks when that has ended."""
    journals: dict[str, Journalctl] = {"a": journalctl}
    journals |= {one: partial(_journalctl, one) for one in OTHERS}
    begin = {machine: end_of_journal(ask) for machine, ask in journals.items()}
    assert all(begin.values()), begin
    yield
    expected = [m for mark in request.node.iter_markers("warns") for m in mark.args]
    found = {one: complaints(begin[one], expected, ask) for one, ask in journals.items()}
    told = [f"{machine}: {line}" for machine, lines in found.items() for line in lines]
    assert not told, "unexpected warnings:\n" + "\n".join(told)
