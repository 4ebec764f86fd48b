"""Dataflows are enabled, and the system is shut down while they run."""

import json
import shutil

from tests.deb.packages import install
from tests.platforms import test_packages, test_uv
from tests.platforms.enabled import NOTES, USERS, doractl, project_of, row
from tests.system.cells import Project, wait_for


def test_a_life_until_the_reboot() -> None:
    install()
    test_uv.install_by_uv()
    notes = {}
    for user in USERS:
        project = Project(project_of(user))
        flow = project.three_nodes()
        shutil.chown(project.root, user, user)
        doractl(user, f"start {flow} --name robot --venv {test_packages.LAB} --network host")
        doractl(user, "enable robot")
        logs = "logs robot --node sink -o cat --no-pager"
        wait_for("the sink prints", lambda: "got" in doractl(user, logs))  # noqa: B023
        notes[user] = row(user)["uuid"]
    NOTES.write_text(json.dumps(notes))
