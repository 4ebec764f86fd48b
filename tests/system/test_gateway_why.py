"""The status page answers what failed, why, since when and what to do, in a real browser."""

import json
from pathlib import Path

import pytest

from tests.system.cells import THREE_NODES, TICK, Cell, Project, sync_journal, wait_for
from tests.system.chromium import Browser
from tests.system.gateways import Front
from tests.system.pages import CONTRAST, CUT, SCHEMES, box, faults, node
from tests.system.test_why import CRASHES, TAKER, bad, failed

pytestmark = [pytest.mark.lab, pytest.mark.browser, pytest.mark.usefixtures("gateway_up")]

LONG = "camera-front-left-with-a-long-name"
BREAKS = """
from dora import Node
for place, event in enumerate(Node()):
    print("line", place, "<b>bold</b>", flush=True)
    if place == 30:
        raise RuntimeError("no camera")
"""
NOBODY = "11111111-2222-4333-8444-555555555555"
CONTROLLERS = Path("/sys/fs/cgroup/cgroup.controllers")
SAVED = """
(() => {
  const make = URL.createObjectURL;
  URL.createObjectURL = (blob) => { window.saved = blob; return make.call(URL, blob); };
})()
"""
"""Keeps what is downloaded, for a look at it."""
CARDS = "[...document.querySelectorAll('#list .card strong')].map((e) => e.textContent)"


def degraded(cell: Cell, project: Project) -> None:
    """Three nodes that run, and one with a long name that has failed."""
    project.three_nodes()
    project.write("breaks.py", BREAKS)
    lone = f"  - {{id: {LONG}, path: breaks.py, inputs: {{tick: {TICK}}}}}\n"
    cell.start(project.write("dataflow.yml", THREE_NODES + lone))
    wait_for("it is degraded", lambda: cell.status.stage == "degraded")


def look(browser: Browser, name: str) -> None:
    """Pictures on a desktop and on a telephone, where everything is to be read as well."""
    for scheme in SCHEMES:
        browser.prefer(scheme)
        browser.resize(1280, 900)
        browser.wait_js("document.querySelectorAll('.graph .box').length > 1")
        assert browser.js(CONTRAST) == [], scheme
        assert faults(browser) == [], scheme
        browser.picture(f"{name}-{scheme}", is_whole=True)
        browser.resize(320, 740, is_phone=True)
        browser.wait_js("document.documentElement.scrollWidth === 320")
        assert browser.js(CONTRAST) == [], scheme
        assert browser.js(CUT) == [], scheme
        assert faults(browser) == [], scheme
        browser.picture(f"{name}-phone-{scheme}", is_whole=True)


@pytest.mark.warns(*CRASHES)
def test_one_that_failed(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(bad(project), check=False)
    failed(cell)
    browser.wait_text("#detail .badge", "Failed")
    browser.wait_text("#detail .why h2", "Why it failed")
    browser.wait_text("#detail .why .summary", "node bad: exit code 1")
    assert "failed:" not in browser.text("#detail .title"), "the badge says it"
    browser.wait_text("#detail .why dl", "ago")
    assert "taker" in browser.text("#detail .why dl"), "the node without input"
    assert f"doractl restart {cell.name}" in browser.text("#detail .why .remedies code")
    browser.wait_text("#detail .why .words", "RuntimeError: no camera")
    browser.wait_text("#detail .why .timeline", "crashed")
    # The true states, in the list and in the drawing.
    browser.wait_text(f"{node('bad')} .badge", "Failed")
    assert "exit code 1" in browser.text(node("bad"))
    browser.wait_js(f"document.querySelector({json.dumps(box('bad'))})?.dataset.tone === 'bad'")
    assert "unknown" not in browser.text(".graph").lower()
    assert "unknown" not in browser.text("#detail .nodes").lower()
    # No graph of nothing.
    assert not browser.js("document.querySelector('#detail .charts .chart').checkVisibility()")
    browser.wait_text("#totals", "1 failed")
    assert "1 dataflow" in browser.text("#totals"), "it has a card"
    look(browser, "failed")
    assert browser.failures() == []


@pytest.mark.warns(*CRASHES, "node_failure", "Degraded")
def test_one_that_is_degraded(browser: Browser, cell: Cell, project: Project) -> None:
    degraded(cell, project)
    browser.wait_text("#detail .badge", "Degraded")
    browser.wait_text("#detail .why h2", "Why it is degraded")
    browser.wait_text("#detail .why .summary", f"node {LONG}: exit code 1")
    browser.wait_text("#detail .why .words", "<b>bold</b>")
    browser.wait_text("#list .card .facts", f"failed: {LONG} (exit code 1)")
    assert browser.js("document.querySelectorAll('#detail .why .words b').length") == 0
    browser.wait_text(f"{node(LONG)} .badge", "Failed")
    browser.wait_text(f"{node('sink')} .badge", "Running")
    browser.wait_js("document.querySelectorAll('.graph .box').length === 4")
    name = f"[...document.querySelectorAll({json.dumps(box(LONG) + ' .name')})]"
    assert browser.js(f"{name}.map((e) => e.textContent).join('')") == LONG
    # From the reason to the node's logs.
    browser.click("#detail .why button.small")
    browser.wait_js(f"document.querySelector('#log-node').value === {json.dumps(LONG)}")
    browser.wait_text(".lines", "RuntimeError: no camera")
    assert "got [" not in browser.text(".lines")
    # The same node again: all of them.
    browser.click(box(LONG))
    browser.wait_text(".lines", "got [")
    look(browser, "degraded")
    assert browser.failures() == []


def test_one_that_runs(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("#detail .badge", "Running")
    browser.wait_text("#detail dl", "Sandbox")
    facts = browser.text("#detail article > dl")
    for words in ("none", "off", "default", "not started", cell.unit):
        assert words in facts, facts
    browser.wait_text(".lines", "got [")
    assert browser.js("document.querySelector('#detail .why').hidden")
    look(browser, "running")
    assert browser.failures() == []


@pytest.mark.warns(*CRASHES)
def test_failed_ones_come_first(browser: Browser, cell: Cell, project: Project) -> None:
    healthy = Cell("aaa-runs")
    try:
        cell.start(bad(project), check=False)
        failed(cell)
        healthy.start(project.three_nodes())
        wanted = json.dumps([cell.name, healthy.name])
        browser.wait_js(f"JSON.stringify({CARDS}) === {json.dumps(wanted.replace(', ', ','))}")
        assert browser.text("#list .card").startswith(cell.name)
        assert browser.text("#detail h1") == cell.name
    finally:
        healthy.end()


@pytest.mark.warns(*CRASHES)
def test_mended_and_started_again(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(bad(project), check=False)
    failed(cell)
    browser.wait_text("#detail .why h2", "Why it failed")
    browser.wait_js("!document.querySelector('#detail [data-action=stop]').checkVisibility()")
    project.write("bad.py", TAKER)
    browser.click("#detail [data-action=start]")
    browser.wait_text("#question", f"Start {cell.name}?")
    browser.click("#confirmed")
    browser.wait_text("#said", "Dataflow restarted")
    browser.wait_text("#detail .badge", "Running")
    browser.wait_js("document.querySelector('#detail .why').hidden")
    browser.wait_text("#host", "this machine:")
    browser.wait_text(f"{node('bad')} .badge", "Running")
    assert browser.failures() == []


def test_logs_are_searched_and_saved(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(".lines", "got [")
    texts = "[...document.querySelectorAll('.lines .text')].map((e) => e.textContent)"
    browser.fill("#log-search", "SENT 1")
    browser.wait_text(".logs .found", "0 lines found")
    browser.wait_text(".lines", "No line matches")
    browser.fill("#log-search", "sent 1")
    browser.wait_text(".logs .found", "found")
    browser.wait_js(f"{texts}.length > 0")
    assert all("sent 1" in one for one in browser.js(texts))
    assert browser.js("document.querySelector('#log-follow').disabled")
    browser.js(SAVED)
    browser.click("#log-save")
    browser.wait_js("window.saved !== undefined")
    lines = browser.js("window.saved.text()").splitlines()
    assert lines
    assert all("Z source: sent 1" in one for one in lines)
    # Without words, it follows again.
    browser.fill("#log-search", "")
    browser.wait_text(".lines", "got [")
    assert not browser.js("document.querySelector('#log-follow').disabled")
    assert browser.failures() == []


def test_logs_of_a_time_and_of_the_run_before(
    browser: Browser, cell: Cell, project: Project
) -> None:
    flow = project.three_nodes()
    cell.start(flow)
    browser.wait_text(".lines", "got [")
    browser.fill("#log-run", "PREVIOUS")
    browser.wait_text(".lines", f"cannot find the previous run of dataflow {cell.name}")
    project.write("sink.py", 'print("another program", flush=True)\n' + TAKER)
    cell.doractl("restart", cell.name)
    sync_journal()
    browser.fill("#log-run", "CURRENT")
    browser.wait_text(".lines", "another program")
    assert "got [" not in browser.text(".lines")
    browser.fill("#log-run", "PREVIOUS")
    browser.wait_text(".lines", "got [")
    assert "another program" not in browser.text(".lines")
    browser.fill("#log-run", "")
    browser.fill("#log-time", "10m")
    browser.wait_text(".logs .found", "found")
    browser.fill("#log-time", "range")
    browser.fill("#log-to", "2001-01-01T00:00:00")
    browser.wait_text(".lines", "No line matches")
    assert browser.failures() == []


def test_what_can_be_changed(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("#detail dl", "Sandbox")
    try:
        for action, said in (
            ("hot-reload", "Hot reload on"),
            ("reload", "Nothing has changed"),
            ("enable", "Dataflow enabled"),
            ("disable", "Dataflow disabled"),
        ):
            choose(browser, action)
            browser.click("#confirmed")
            browser.wait_text("#said", said)
            facts = {"hot-reload": "on", "enable": "started"}
            if action in facts:
                browser.wait_text("#detail article > dl", f"\n{facts[action]}\n")
    finally:
        cell.doractl("disable", cell.name, check=False)
    assert browser.failures() == []


def test_limits_are_changed(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("#detail dl", "Sandbox")
    browser.click("#detail .menu summary")
    assert faults(browser) == []
    browser.press("Escape")
    assert not browser.js("document.querySelector('#detail .menu').open")
    choose(browser, "set")
    browser.wait_text("#question", f"Limits of {cell.name}")
    assert browser.js("document.activeElement.id") == "memory_limit"
    assert faults(browser) == []
    browser.picture("limits")
    browser.js("document.querySelector('#memory_limit').value = 'much', 0")
    browser.click("#confirmed")
    browser.wait_text("#said", "cannot read 'much' as a size")
    choose(browser, "set")
    browser.js("document.querySelector('#memory_limit').value = '3G', 0")
    browser.press("Enter", "\r")
    if "memory" in CONTROLLERS.read_text():
        browser.wait_text("#said", "Limits changed")
        assert cell.show("MemoryMax") == str(3 << 30)
        browser.wait_text("#detail article > dl", "memory 3G")
    else:
        browser.wait_text("#said", "memory")
    assert browser.failures() == []


def test_limits_of_a_node_are_changed(browser: Browser, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text("#detail dl", "Sandbox")
    button = "[aria-label='Limits sink']"
    for given, shown in (("500", "sink:tasks_limit=500"), ("", "\nnone\n")):
        browser.wait_js(f'!document.querySelector("{button}").disabled')
        browser.click(button)
        browser.wait_text("#question", f"Limits of node sink of {cell.name}")
        browser.js(f"document.querySelector('#tasks_limit').value = '{given}', 0")
        browser.click("#confirmed")
        if "pids" not in CONTROLLERS.read_text():
            browser.wait_text("#said", "tasks")
            break
        browser.wait_text("#said", "Limits changed")
        browser.wait_text("#detail article > dl", shown)
    assert browser.failures() == []


def choose(browser: Browser, action: str) -> None:
    """Choose an action of the menu, as soon as nothing else is being done."""
    button = f"#detail [data-action={action}]"
    browser.wait_js(f"!document.querySelector({json.dumps(button)}).disabled")

    def is_shown() -> bool:
        # Once more, as a person does, if what is above has moved the menu away from the pointer.
        if not browser.js("document.querySelector('#detail .menu').open"):
            browser.click("#detail .menu summary")
        return bool(browser.js(f"document.querySelector({json.dumps(button)}).checkVisibility()"))

    wait_for("the menu is open", is_shown)
    browser.click(button)
    browser.wait_js("document.querySelector('#confirm').open")


def test_one_that_has_ended(browser: Browser, front: Front, cell: Cell, project: Project) -> None:
    cell.start(project.three_nodes())
    browser.wait_text(".lines", "got [")
    uuid = cell.status.uuid
    cell.doractl("stop", cell.name)
    browser.wait_text("#detail .badge", "Stopped")
    browser.wait_text("#detail .why .summary", "(doractl stop)")
    browser.wait_text(f"{node('sink')} .badge", "Stopped")
    browser.wait_text("#ended summary", "Ended (")
    browser.js("document.querySelector('#ended').open = true")
    assert faults(browser) == []
    # By its address, later.
    browser.open(f"http://127.0.0.1:{front.port}/?later#{uuid}")
    browser.wait_text("#detail h1", cell.name)
    browser.wait_text(".lines", "got [")
    browser.wait_text("#detail .why .summary", "(doractl stop)")
    # What nobody knows has a word, and a way back.
    browser.js(f"location.hash = '#{NOBODY}', 0")
    browser.wait_text("#gone", "no longer there")
    assert faults(browser) == []
    browser.click("#gone .back")
    browser.wait_text("#none", "No dataflow is running")
    assert browser.failures() == []
