"""`doractl set --node sink:log_rate_limit=`: a node is quieted while it runs, and restarted."""

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, wait_for


def suppressed(cell: Cell) -> list[tuple[str, str]]:
    """The nodes and limits for which this life of the unit has suppressed lines."""
    life = f"_SYSTEMD_INVOCATION_ID={cell.show('InvocationID')}"
    found = cell.journal("DORA_EVENT=lines-suppressed", life)
    return [(one["DORA_NODE"], one["DORA_LIMIT"]) for one in found]


def has_all(cell: Cell) -> bool:
    """Whether the last lines of the sink have no gap."""
    numbers = [int(line.strip("got []")) for line in cell.messages("sink")[-10:]]
    return len(numbers) == 10 and numbers[-1] - numbers[0] == 2 * 9


@pytest.mark.warns("exceed its limit")
def test_at_once_and_after_a_restart(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes(), "--node", "source:log_rate_limit=infinity")
    runner = cell.supervisor_pid("runner")
    done = cell.doractl("set", cell.name, "--node", "sink:log_rate_limit=1/1s")
    assert done.stdout.startswith("Limits changed: ")
    wait_for("lines are suppressed", lambda: suppressed(cell))
    assert cell.supervisor_pid("runner") == runner
    cell.doractl("restart", cell.name)
    wait_for("they are again", lambda: suppressed(cell))
    assert set(suppressed(cell)) == {("sink", "1/1s")}
    cell.doractl("set", cell.name, "--node", "sink:log_rate_limit=infinity")
    wait_for("all lines are there", lambda: has_all(cell))
    variables = "DORA_SYSTEMD_SET=sink:log_rate_limit=infinity"
    assert variables in cell.doractl("show", cell.name).stdout


def test_wrong_ones_change_nothing(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    before = cell.doractl("show", cell.name).stdout
    for text, status in (("sinc:1/1s", ExitCode.BAD_INPUT), ("sink:much", ExitCode.USAGE)):
        wrong = text.replace(":", ":log_rate_limit=")
        words = ("--node", "source:log_rate_limit=1/1s", "--node", wrong)
        done = cell.doractl("set", cell.name, *words, check=False)
        assert (done.returncode, len(done.stderr.splitlines())) == (status, 2)
    assert cell.doractl("show", cell.name).stdout == before
