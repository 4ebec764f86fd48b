"""The past of a dataflow on the status page: its timeline and its bundles."""

import json
import os
import re
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.decisions.gateway.timeline import MOST_MARKS
from dora_systemd.gateway.live.past import read_timeline
from dora_systemd.scope import Scope
from tests.system.cells import TICK, Cell, Project, journalctl, sync_journal, wait_for
from tests.system.chromium import Browser
from tests.system.gateways import Front
from tests.system.pages import look, node

pytestmark = [pytest.mark.lab, pytest.mark.browser, pytest.mark.usefixtures("gateway_up")]

STORE = Path("/var/lib/dora-systemd/bundles")
LINES = """
from dora import Node
for place, event in enumerate(Node()):
    print("line", place, "<b>bold</b>", flush=True)
"""
FLOW = (
    "nodes:\n"
    f"  - {{id: shaky, path: lines.py, inputs: {{tick: {TICK}}}, restart_policy: on-failure,"
    " restart_delay: 0.1, max_restarts: 3}\n"
)
FORGER = """
import socket
from pathlib import Path
from dora import Node
sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
is_done = False
for _ in Node():
    if not is_done and Path("uuid").exists():
        uuid = Path("uuid").read_text()
        text = "<img src=x onerror=alert(1)>\\x1b[31mred"
        entry = f"MESSAGE={text}\\nDORA_EVENT=node-crashed\\nDORA_DATAFLOW={uuid}\\n".encode()
        for _ in range(8000):
            sock.sendto(entry, "/run/systemd/journal/socket")
        print("forged", flush=True)
        is_done = True
"""
THINGS = "[...document.querySelectorAll('.past .thing')].map((e) => e.getAttribute('aria-label'))"
FOCUSED = "document.activeElement.getAttribute('aria-label')"
PHONE = (320, 740)
ALIVE = ("running", "ready")
KILLED = ("crashed", "restarted", "node_failure", "Signal(9)")


@pytest.fixture
def shaky(cell: Cell, project: Project) -> Iterator[Cell]:
    """A dataflow whose node has crashed once, and runs again."""
    project.write("lines.py", LINES)
    cell.start(project.write("dataflow.yml", FLOW))
    wait_for("it writes", lambda: "line 5 " in journalctl("-o", "cat", "-u", cell.unit))
    (pid,) = cell.pids("node-shaky")
    os.kill(pid, signal.SIGKILL)
    wait_for("it runs again", lambda: cell.status.nodes["shaky"].restarts == 1)
    wait_for("it is ready", lambda: cell.status.nodes["shaky"].state in ALIVE)
    sync_journal()
    yield cell
    shutil.rmtree(STORE / cell.name, ignore_errors=True)


def marks(browser: Browser, word: str) -> list[str]:
    """The labels of the things on the axis that have this word."""
    return [str(one) for one in browser.js(THINGS) if word in one]


@pytest.mark.warns(*KILLED)
def test_what_happened_before_the_page_was_opened(
    browser: Browser, shaky: Cell, front: Front
) -> None:
    browser.open(f"http://127.0.0.1:{front.port}/?later#{shaky.status.uuid}")
    browser.wait_js(f"{THINGS}.some((one) => one.includes('crashed'))")
    assert marks(browser, "Running, from"), "the life"
    assert marks(browser, "restarted"), "and that dora has restarted the node"
    browser.wait_text(".past .legend", "F failure")
    browser.wait_js("document.querySelector('.past .line.cpu').getAttribute('d') !== ''")
    # A click shows the log of that moment.
    browser.fill("#past-range", "0.25")
    browser.click(".past .thing[data-tone=bad]")
    browser.wait_js("document.querySelector('#log-time').value === 'range'")
    browser.wait_text(".logs .found", "found around")
    browser.wait_text(".lines", "line 5")
    browser.wait_js("document.querySelector('.lines .moment') !== null")
    assert browser.js("document.activeElement.className") == "lines"
    browser.wait_text(".past .chosen", "SIGKILL")
    browser.wait_text(f"{node('shaky')} .facts", "PID ")
    browser.wait_text(f"{node('shaky')} .facts", "1 restart of 3")
    look(browser, "timeline")
    browser.resize(*PHONE, is_phone=True)
    browser.wait_js("document.documentElement.scrollWidth === 320")
    look(browser, "timeline-phone")
    assert browser.failures() == []


BURNER = """
import time
from dora import Node
node = Node()
end = time.process_time() + 1.5
while time.process_time() < end:
    pass
print("burned", flush=True)
for event in node:
    pass
"""
MEANS = "document.querySelector('.past .mean.cpu').getAttribute('d').split('M').length - 1"


def test_what_lives_have_used_before_the_page_was_opened(
    browser: Browser, cell: Cell, project: Project, front: Front
) -> None:
    """The life that has ended by systemd's record, the present one by its cgroup."""
    project.write("lines.py", BURNER)
    cell.start(project.write("dataflow.yml", FLOW))
    wait_for("it has used CPU", lambda: "burned" in journalctl("-o", "cat", "-u", cell.unit))
    cell.doractl("restart", cell.name)
    sync_journal()
    browser.open(f"http://127.0.0.1:{front.port}/?later#{cell.status.uuid}")
    browser.wait_js(f"{MEANS} === 2")
    first, second = marks(browser, ", from ")
    for text in (first, second):
        assert re.search(r"CPU [0-9.]+\xa0% on average", text), text
    assert "Stopped, from" in first
    browser.wait_text(".past .legend", "dotted line: the average of a life")
    look(browser, "before")
    browser.resize(*PHONE, is_phone=True)
    browser.wait_js("document.documentElement.scrollWidth === 320")
    look(browser, "before-phone")
    assert browser.failures() == []


def test_what_a_node_forges_is_bounded_text(
    browser: Browser, cell: Cell, project: Project, front: Front
) -> None:
    project.write("lines.py", FORGER)
    cell.start(project.write("dataflow.yml", FLOW))
    uuid = cell.status.uuid
    project.write("uuid", uuid)
    wait_for("it has forged", lambda: "forged" in journalctl("-o", "cat", "-u", cell.unit))
    sync_journal()
    began = time.monotonic()
    found = read_timeline(Scope(False, 0), uuid)
    print(f"read in {time.monotonic() - began:.2f} s, {len(json.dumps(found))} bytes")
    assert (len(found["marks"]), found["is_cut"]) == (MOST_MARKS, True)
    browser.open(f"http://127.0.0.1:{front.port}/?later#{uuid}")
    browser.wait_text(".past .note", "There was more than is shown here")
    assert marks(browser, "<img src=x onerror=alert(1)>red")
    assert browser.js("document.querySelectorAll('.past img').length") == 0
    assert browser.failures() == []


@pytest.mark.warns(*KILLED)
@pytest.mark.usefixtures("shaky")
def test_the_timeline_without_a_pointer(browser: Browser) -> None:
    browser.wait_js(f"{THINGS}.some((one) => one.includes('crashed'))")
    reached = browser.js("document.querySelectorAll('.past .thing[tabindex=\"0\"]').length")
    assert (reached, bool(marks(browser, "Running, from"))) == (1, True)
    browser.js("document.querySelector('#past-range').focus(), 0")
    browser.press("Tab")
    seen = [browser.js(FOCUSED)]
    for _ in range(10):
        browser.press("ArrowLeft")
        seen.append(browser.js(FOCUSED))
    assert set(seen) == set(browser.js(THINGS)), seen
    browser.press("End")
    browser.press("Enter", "\r")
    browser.wait_js("document.querySelector('#log-time').value === 'range'")
    browser.wait_text(".logs .found", "found")
    # The axis moves on, and the focus stays on the same mark.
    browser.js("document.querySelector('.past .thing[data-tone=bad]').focus(), 0")
    held = browser.js("document.activeElement.dataset.key")
    browser.resize(1000, 900)
    browser.wait_js("document.querySelector('.past svg').getAttribute('width') < 900")
    assert browser.js("document.activeElement.dataset.key") == held
    assert browser.failures() == []


def test_bundles_are_listed_and_downloaded(
    browser: Browser, cell: Cell, project: Project, front: Front
) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("section[aria-label=Bundles]", f"doractl bundle {cell.name}")
    browser.wait_text("section[aria-label=Releases]", f"--name {cell.name}")
    try:
        browser.click("#detail [data-action=bundle]")
        browser.wait_text("#question", f"Write a bundle of {cell.name}?")
        browser.click("#confirmed")
        browser.wait_text("#said", "Bundle written", 60)
        (path,) = (STORE / cell.name).iterdir()
        browser.wait_text(".bundles", "by root (status page)")
        sync_journal()
        browser.open(f"http://127.0.0.1:{front.port}/?later")
        browser.wait_text(".bundles", path.name)
        browser.wait_text(".bundles", "requested")
        link = "document.querySelector('.bundles a')"
        assert browser.js(f"{link}.getAttribute('download')") == path.name
        size = browser.js(f"fetch({link}.href).then((a) => a.blob()).then((one) => one.size)")
        assert size == path.stat().st_size
        # The same door as that of the page.
        place = f"/bundles/{cell.name}/{path.name}"
        assert front.get(place, user="alice").status == 401
        assert front.get(place, "-H", "Origin: http://elsewhere").status == 403
        assert front.get(f"/bundles/{cell.name}/../../x").status == 404
        browser.wait_js(f"{THINGS}.some((one) => one.includes('is written'))")
        look(browser, "bundles")
        # Without a pointer: the button, then the bundle.
        browser.js("document.querySelector('#detail [data-action=bundle]').focus(), 0")
        browser.press("Tab")
        assert browser.js("document.activeElement.textContent") == path.name
        browser.resize(*PHONE, is_phone=True)
        browser.wait_js("document.documentElement.scrollWidth === 320")
        look(browser, "bundles-phone")
    finally:
        shutil.rmtree(STORE / cell.name, ignore_errors=True)
    assert browser.failures() == []
