"""Each fault of the table, applied to a dataflow under load: what must hold then, and how soon."""

import time

from tests.system.cells import Cell, Project, wait_for
from tests.system.faults import checks
from tests.system.faults.conftest import Recoveries
from tests.system.faults.scene import ROLES, Scene
from tests.system.faults.table import Fault


def test_fault(fault: Fault, cell: Cell, project: Project, recoveries: Recoveries) -> None:
    with Scene(cell, project) as scene:
        check_fault(scene, fault, recoveries)


def check_fault(scene: Scene, fault: Fault, recoveries: Recoveries) -> None:
    """Apply the fault, and look at everything that must hold then."""
    cell = scene.cell
    if fault.prepare is not None:
        fault.prepare(scene)
    scene.start(fault.flags, fault.answers)
    group = cell.group

    begun = time.monotonic()
    fault.apply(scene)
    wait_outcome(scene, fault)
    recoveries.note(fault.name, time.monotonic() - begun)

    checks.check_nothing_is_outside(scene)
    checks.check_list(scene, fault.outcome, fault.cause)
    scene.unmount()
    cell.end()
    checks.check_nothing_is_left(scene, group)
    checks.check_lines(scene, fault.repeats)
    checks.check_cause(scene, fault.cause)


def wait_outcome(scene: Scene, fault: Fault) -> None:
    """Return when the outcome is there; say what there was if it is not there in time."""
    recovered = checks.RECOVERED[fault.outcome]
    try:
        wait_for(fault.outcome.value, lambda: recovered(scene), fault.seconds)
    except AssertionError as error:
        said = [str(record["MESSAGE"]) for record in scene.cell.journal("--lines=2000")]
        events = [message for message in said if message.partition(".")[0] not in ROLES]
        error.add_note("\n".join(["", str(scene.before), str(scene.state()), *events]))
        raise
