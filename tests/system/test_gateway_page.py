"""The status page of a real gateway, with real dataflows, in a real browser."""

import json

import pytest

from dora_systemd.decisions.gateway.place import SERVICE_UNIT, SOCKET_UNIT
from tests.system import recorders
from tests.system.cells import TICK, Cell, Project, journalctl, wait_for
from tests.system.chromium import Browser
from tests.system.gateways import Front
from tests.system.pages import faults, look, node

pytestmark = [pytest.mark.lab, pytest.mark.browser, pytest.mark.usefixtures("gateway_up")]

HOSTILE = """
from dora import Node
node, count = Node(), 0
for event in node:
    if event["type"] == "INPUT" and count < 3:
        print("<img src=x onerror=alert(1)>\\x1b[31mred\\x1b[0m &amp; \\x07bell", flush=True)
        count += 1
"""
FLOOD = """
from dora import Node
count = 0
for event in Node():
    for _ in range(400):
        print("line", count)
        count += 1
"""
STRUCK = """
[...document.querySelectorAll('#detail .charts .chart')].map((chart) => {
  const place = (name) => chart.querySelector(name).getBoundingClientRect();
  return [place('.top').bottom, place('.line').top];
}).filter(([label, line]) => label > line)
"""


def test_what_runs(browser: Browser, cell: Cell, project: Project) -> None:
    browser.wait_text("#none", "doractl start")
    assert faults(browser) == []
    cell.start(project.three_nodes())
    browser.wait_text("#list .card", cell.name)
    browser.wait_text("#detail h1", cell.name)
    for name in ("source", "doubler", "sink"):
        browser.wait_text(f"{node(name)} .badge", "Running")
    browser.wait_text("#detail dl", "3 of 3")
    browser.wait_text("#detail dl", str(project.root / "dataflow.yml"))
    # From the second snapshot on there is a line to draw.
    browser.wait_js("document.querySelector('#detail .charts .line').getAttribute('d') !== ''")
    browser.wait_text("#detail .charts .memory .value", "MiB")
    for words in ("now", " ago"):
        browser.wait_text("#detail .charts .axis", words)
    assert browser.js(STRUCK) == [], "no line goes through the label of a chart"
    browser.point("#detail .charts svg", 0.98)
    browser.wait_text("#detail .charts .of", "at ")
    drawn = "[...document.querySelectorAll('.graph {}')].map((e) => e.textContent)"
    assert len(browser.wait_js(drawn.format(".box"))) == 3
    assert set(browser.js(drawn.format(".edge title"))) == {
        f"{TICK} → source: tick",
        "source → doubler: number",
        "doubler → sink: double",
    }
    browser.wait_text(".lines", "got [")
    shown = browser.js(
        "[...document.querySelectorAll('#detail .nodes li')].map((e) => e.dataset.node)"
    )
    listed = json.loads(cell.doractl("list", cell.name, "-o", "json").stdout)["nodes"]
    assert shown == [one["node"] for one in listed] == ["source", "doubler", "sink"]
    assert browser.failures() == []


def test_how_long_a_node_has_to_stop(browser: Browser, cell: Cell, project: Project) -> None:
    recorders.start(cell, recorders.flow(project, seconds=5))
    browser.wait_text(f"{node('recorder')} .badge", "Running")
    cell.systemctl("stop", "--no-block")
    browser.wait_text(f"{node('recorder')} .sign", " s left to stop")
    browser.wait_text(f"{node('recorder')} .said", "writing episode")
    wait_for("it is gone", lambda: cell.is_gone)
    assert browser.failures() == []


def test_logs_of_one_node_follow(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(".lines", "sent 1")
    browser.wait_js("document.querySelectorAll('.graph .box').length === 3")
    browser.click(".graph [data-node=sink]")
    browser.wait_js("document.querySelector('#log-node').value === 'sink'")
    browser.wait_text(".lines", "got [")
    last = "document.querySelector('.lines p:last-of-type .text').textContent"
    before = browser.js(last)
    browser.wait_js(f"{last} !== {json.dumps(before)}")
    assert "sent" not in browser.text(".lines")
    at_end = "((e) => e.scrollHeight - e.clientHeight - e.scrollTop < 30)"
    overflows = "((e) => e.scrollHeight > 2 * e.clientHeight)"
    browser.wait_js(f"{overflows}(document.querySelector('.lines'))")
    browser.wait_js(f"{at_end}(document.querySelector('.lines'))")
    # Who scrolls up is left in peace.
    browser.js("document.querySelector('.lines').scrollTop = 0")
    browser.wait_js("!document.querySelector('#log-follow').checked")
    assert browser.failures() == []


@pytest.mark.warns("server disconnected", "node_failure", "is being restarted")
def test_buttons(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(f"{node('sink')} .badge", "Running")
    (pid,) = cell.pids("node-sink")
    # No means no.
    browser.click(f"{node('sink')} .buttons button")
    browser.wait_text("#question", f"Restart node sink of {cell.name}?")
    browser.press("Escape")
    browser.wait_js("!document.querySelector('#confirm').open")
    browser.click(f"{node('sink')} .buttons button")
    browser.wait_js("document.querySelector('#confirm').open")
    assert faults(browser) == []
    browser.picture("confirm")
    browser.click("#confirmed")
    browser.wait_text("#said", "Node restarting: sink")
    assert cell.pids("node-sink") != [pid] or wait_for(
        "the node is another one", lambda: cell.pids("node-sink") not in ([pid], [])
    )
    since = cell.show("InvocationID")
    browser.wait_js("!document.querySelector('#detail [data-action=restart]').disabled")
    browser.click("#detail [data-action=restart]")
    browser.click("#confirmed")
    browser.wait_text("#said", "Dataflow restarted")
    assert cell.show("InvocationID") != since
    browser.wait_js("!document.querySelector('#detail [data-action=stop]').disabled")
    browser.click("#detail [data-action=stop]")
    browser.wait_text("#question", f"Stop {cell.name}?")
    browser.click("#confirmed")
    browser.wait_text("#said", "Dataflow stopped")
    assert cell.is_gone
    asked = [one["MESSAGE"] for one in cell_notes(cell)]
    assert any("status page" in text for text in asked), asked
    # It stays, with how it ended, and is among the ended ones.
    browser.wait_text("#detail .badge", "Stopped")
    browser.wait_text("#detail .why .summary", "(status page)")
    assert not browser.js("document.querySelector('#ended').hidden")
    assert browser.failures() == []


def cell_notes(cell: Cell) -> list[dict[str, str]]:
    """Who has asked for the end of the dataflow."""
    name = f"DORA_DATAFLOW_NAME={cell.name}"
    lines = journalctl("-o", "json", name, "DORA_EVENT=stop-asked").splitlines()
    return [json.loads(line) for line in lines]


def test_by_keyboard(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(f"{node('sink')} .badge", "Running")
    browser.wait_js("document.querySelectorAll('.graph .box').length === 3")
    focused = (
        "document.activeElement.getAttribute('aria-label') ?? document.activeElement.textContent"
    )
    seen = []
    for _ in range(40):
        browser.press("Tab")
        seen.append(browser.js(focused))
        if seen[-1] == "Stop sink":
            break
    assert {"Restart", "Stop", "source", "Stop source", "Stop sink"} <= set(seen), seen
    assert any("sink, running" in one for one in seen), seen
    browser.press("Enter", "\r")
    browser.wait_text("#question", f"Stop node sink of {cell.name}?")
    assert browser.js("document.activeElement.textContent") == "Cancel"
    browser.press("Enter", "\r")
    browser.wait_js("!document.querySelector('#confirm').open")
    assert len(cell.pids("node-sink")) == 1


def test_what_nodes_print_is_text(browser: Browser, cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", HOSTILE)
    cell.start(flow)
    browser.wait_text(".lines", "<img src=x onerror=alert(1)>red &amp; \\x07bell")
    assert browser.js("document.querySelectorAll('.lines img').length") == 0
    assert browser.failures() == []


def test_a_flood_is_bounded(browser: Browser, cell: Cell, project: Project) -> None:
    flow = project.three_nodes()
    project.write("sink.py", FLOOD)
    cell.start(flow)
    browser.wait_text(".lines", "skipped here", 60)
    browser.wait_js("document.querySelectorAll('.lines p').length === 1000", 60)
    # And the numbers go on meanwhile.
    before = browser.text("#detail dl")
    wait_for("the page lives", lambda: browser.text("#detail dl") != before)
    assert browser.js("document.querySelectorAll('.lines p').length") == 1000


@pytest.mark.warns("Failed with result", "code=killed")
def test_disconnected_and_back(
    browser: Browser, front: Front, cell: Cell, project: Project
) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("#link", "live")
    front.systemctl("kill", "--signal=KILL", SERVICE_UNIT)
    browser.wait_text("#link", "disconnected")
    browser.wait_text("#link", "live")
    browser.wait_text(".lines", "got [")
    front.systemctl("stop", SOCKET_UNIT)
    browser.wait_text("#link", "disconnected")
    assert browser.js("document.querySelector('#detail [data-action=stop]').disabled")
    browser.wait_text("#problem", "doractl up")
    assert faults(browser) == []
    front.systemctl("start", SOCKET_UNIT)
    browser.click("#again")
    browser.wait_text("#link", "live")


def test_looks(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(".lines", "got [")
    browser.wait_js("document.querySelectorAll('.graph .box').length === 3")
    look(browser, "desktop")
    browser.resize(320, 740, is_phone=True)
    wait = "document.documentElement.scrollWidth"
    assert browser.wait_js(wait) == 320
    look(browser, "phone")
    # The way back to the list, and no sideways scrolling there.
    browser.click(".return")
    browser.wait_js("document.body.dataset.view === 'list'")
    assert browser.js(wait) == 320
    look(browser, "phone-list")
    named = "[...document.querySelectorAll('button, select, input, a')]"
    nameless = f"{named}.filter((e) => e.checkVisibility()).filter((e) =>"
    nameless += " !(e.textContent.trim() || e.ariaLabel || e.labels?.length)).length"
    assert browser.js(nameless) == 0
    assert browser.failures() == []
