"""The example of dora-systemd-nodes(7), NEEDS, is what a system test types and sees."""

from tests.unit.checkout import CHECKOUT
from tests.unit.project.test_examples import plain
from tests.unit.project.test_json_manual import literal_blocks
from tests.unit.project.test_manpages import sections

TASK = CHECKOUT / "tests/system/transcripts/unplugged.txt"


def test_the_camera_robot_of_the_manual() -> None:
    typed = [one for one in TASK.read_text().splitlines() if not one.startswith(("% ", "# "))]
    blocks = map(plain, literal_blocks(sections("dora-systemd-nodes.7")["NEEDS"]))
    assert "\n".join([*typed, ""]) in blocks
