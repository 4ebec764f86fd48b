"""doractl env, for the stock dora command."""

import pytest

from dora_systemd.errors import ExitCode
from tests.system.cells import Cell, Project, run
from tests.system.gateways import Front

pytestmark = pytest.mark.lab


def test_of_one_dataflow(cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    cell.wait_exchanging()
    listed = run("bash", "-c", f'eval "$(doractl env {cell.name})"; dora list').stdout
    assert cell.name in listed
    assert "Running" in listed
    script = f"doractl env {cell.name} --shell fish | source; dora node list"
    assert "doubler" in run("fish", "--no-config", "-c", script).stdout
    refused = run(*_as("alice"), "doractl", "--system", "env", cell.name, check=False)
    assert (refused.returncode, refused.stdout) == (ExitCode.NO_PERMISSION, "")
    cell.systemctl("stop")
    refused = run("doractl", "env", cell.name, check=False)
    assert (refused.returncode, refused.stdout) == (ExitCode.NOT_RUNNING, "")


def test_of_the_gateway(front: Front) -> None:
    refused = front.doractl("env", check=False)
    assert (refused.returncode, refused.stdout) == (ExitCode.NOT_RUNNING, "")
    assert refused.stderr.endswith("hint: doractl up\n")
    front.up()
    curl = 'curl -s -H "Authorization: Bearer $DORA_AUTH_TOKEN" -o /dev/null -w "%{http_code}"'
    url = "http://$DORA_COORDINATOR_ADDR:$DORA_COORDINATOR_PORT/nothing"
    asked = 'eval "$1"; ' + f"{curl} {url}"
    exports = front.doractl("env").stdout
    assert run(*_as("bob"), "bash", "-c", asked, "-", exports).stdout == "404"
    assert run(*_as("bob"), "bash", "-c", asked, "-", exports.upper(), check=False).stdout != "404"
    refused = run(*_as("alice"), "doractl", "--system", "env", check=False)
    assert refused.returncode == ExitCode.NO_PERMISSION
    assert refused.stdout == ""
    told = run(*_as("alice"), "doractl", "--system", "up").stdout
    assert told.endswith("""Use 'eval "$(sudo doractl env)"' to connect the dora command to it\n""")


def _as(user: str) -> tuple[str, ...]:
    return ("runuser", "-u", user, "--")
