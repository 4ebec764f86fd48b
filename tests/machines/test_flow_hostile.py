"""What others on the machines of a dataflow can do, and what a careless sshd would let them."""

import json
import subprocess
from collections.abc import Iterator

import pytest

from dora_systemd.errors import ExitCode
from tests.machines.flows import PLACE, Flow, flow_on
from tests.machines.journals import LOST, announced
from tests.machines.wires import there, wait_up

_STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
_THIEF = """
import socket, sys, time
while True:
    try:
        listener = socket.create_server(("127.0.0.1", int(sys.argv[1])))
        break
    except OSError:
        time.sleep(0.001)
print("listens", flush=True)
listener.settimeout(float(sys.argv[2]))
try:
    print(listener.accept()[0].recv(4096))
except TimeoutError:
    print("nobody came")
"""
OPEN = "/etc/ssh/sshd_config.d/00-open.conf"


@pytest.fixture
def flow(request: pytest.FixtureRequest) -> Iterator[Flow]:
    """A dataflow whose files are everywhere."""
    with flow_on(Flow({"gpu": "b"}), announced(request)) as flow:
        yield flow


@pytest.fixture
def open_sshd() -> Iterator[None]:
    """The sshd of b opens forwarded ports to the network."""
    there("b", f"mkdir -p /etc/ssh/sshd_config.d; echo GatewayPorts yes > {OPEN}")
    there("b", "systemctl restart ssh")
    wait_up("b")
    assert "gatewayports yes" in there("b", "/usr/sbin/sshd", "-T").stdout
    yield
    there("b", f"rm {OPEN}; systemctl restart ssh")
    wait_up("b")


@pytest.mark.warns(*LOST, "runs another doubler.py than the one here")
def test_a_port_of_a_lost_link_is_a_trap(flow: Flow) -> None:
    """dora's daemon looks for its coordinator again, after 5 s, and shows it the token."""
    there("b", f"sed -i '1i {_STUBBORN}' {PLACE}/doubler.py")
    there("b", f"cat > /tmp/thief.py <<'END'\n{_THIEF}\nEND")
    flow.start("--grace-duration=12s", "--restart-policy=no")
    flow.wait_exchanging()
    port = json.loads(flow.cell.paths.control.read_text())["port"]
    thief = ("ssh", "-oBatchMode=yes", "alice@b", "python3", "/tmp/thief.py", str(port), "9")
    with subprocess.Popen(thief, stdout=subprocess.PIPE, text=True) as said:
        assert said.stdout
        there("b", "kill -9 $(ps -o ppid= $(pgrep -f '[d]ora_systemd.link.relay'))")
        assert said.stdout.readline() == "listens\n"
        assert there("b", "pgrep", "-f", f"{PLACE}/doubler.py").stdout
        assert said.stdout.read() == "nobody came\n"


@pytest.mark.warns(*LOST, "Failed to start dora-flow.service")
def test_an_sshd_that_opens_forwards(flow: Flow, open_sshd: None) -> None:
    """Nothing but sshd is reached from the network, so nothing runs."""
    del open_sshd
    done = flow.start(check=False)
    assert done.returncode == ExitCode.BAD_INPUT, done.stderr
    assert "machine gpu: sshd there opens forwarded ports" in done.stderr
    assert "GatewayPorts no" in done.stderr
    assert not flow.left()
    reached = [line.split()[3] for line in there("b", "ss", "-Hltn").stdout.splitlines()]
    assert {one for one in reached if not one.startswith(("127.0.0.1:", "[::1]:"))} == {
        "0.0.0.0:22",
        "[::]:22",
    }
