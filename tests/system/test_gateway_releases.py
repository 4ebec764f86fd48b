"""The releases of a dataflow on the status page, and its button that rolls back."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Project, journalctl, run, wait_for
from tests.system.chromium import Browser
from tests.system.pages import CONTRAST, faults
from tests.system.releases import Releases, write_version
from tests.system.test_inhibit import inhibiting

pytestmark = [pytest.mark.lab, pytest.mark.browser, pytest.mark.usefixtures("gateway_up")]

FLAG = Path("/run/dora-test-broken")
BROKEN = f"import pathlib\nif pathlib.Path('{FLAG}').exists(): raise SystemExit(3)\n"


@pytest.fixture
def flag() -> Iterator[Path]:
    """A file whose presence breaks the first release."""
    yield FLAG
    FLAG.unlink(missing_ok=True)


def row(release: str) -> str:
    return f"#detail .releases [data-release='{release}']"


def states(browser: Browser) -> list[str]:
    script = "[...document.querySelectorAll('.releases .badge')].map((e) => e.textContent)"
    return [str(one) for one in browser.js(script)]


def confirm(browser: Browser, release: str) -> None:
    """Press the button of a release and say yes."""
    browser.wait_js(f'!document.querySelector("{row(release)} button").disabled')
    browser.click(f"{row(release)} button")
    browser.wait_text("#question", f"to {release}?")
    browser.click("#confirmed")


@pytest.mark.warns("crashed", "failed", "Failed", "exited", "exit code", "error", "Error")
def test_roll_back(browser: Browser, releases: Releases, project: Project, flag: Path) -> None:
    cell = releases.cell
    write_version(project, "1", BROKEN)
    releases.deploy(project.root, "--soak", "0s")
    first = releases.current()
    write_version(project, "2")
    releases.deploy(project.root, "--soak", "0s")
    second = releases.current()
    browser.wait_text("#list .card", f"release {second}")
    browser.wait_text(f"{row(second)} .badge", "Current")
    browser.wait_text(f"{row(first)} .badge", "Proved")
    browser.wait_text("#detail dl", second)
    shown = 'document.querySelector("{} button").checkVisibility()'
    assert [browser.js(shown.format(row(one))) for one in (first, second)] == [True, False]
    browser.resize(1200, 900)
    browser.picture("releases", is_whole=True)
    browser.resize(360, 740, is_phone=True)
    assert browser.wait_js("document.documentElement.scrollWidth") == 360
    assert browser.js(CONTRAST) == []
    assert faults(browser) == []
    browser.picture("releases-phone", is_whole=True)
    browser.resize(1200, 900)
    # No means no.
    life = cell.show("InvocationID")
    browser.click(f"{row(first)} button")
    browser.wait_text("#question", f"Roll back {cell.name} to {first}?")
    browser.picture("releases-question")
    browser.press("Escape")
    browser.wait_js("!document.querySelector('#confirm').open")
    # Nor does anything happen while it is inhibited.
    with inhibiting(cell) as child:
        confirm(browser, first)
        browser.wait_text("#said", f"cannot rollback {cell.name}: inhibited by")
        child.kill()
        child.wait()
    assert cell.show("InvocationID") == life
    # One that fails its trial gives way to what ran before.
    flag.touch()
    confirm(browser, first)
    browser.wait_text("#said", "was rolled back: node a: exit code 3", 60)
    browser.wait_text("#detail dl", f"Release {first} of")
    assert (releases.running(), releases.current()) == (second, second)
    assert not releases.trial.exists()
    browser.picture("releases-failed", is_whole=True)
    flag.unlink()
    confirm(browser, first)
    browser.wait_text("#said", f"runs release {first}", 60)
    browser.wait_text(f"{row(first)} .badge", "Current")
    browser.wait_text(f"{row(second)} .badge", "Rolled-back")
    browser.wait_text(f"{row(second)} .facts", "by root (status page)")
    assert states(browser) == ["Rolled-back", "Current"]
    assert (releases.running(), releases.current()) == (first, first)
    assert any("(status page)" in text for text in committed(releases))
    assert browser.failures() == []


def committed(releases: Releases) -> list[str]:
    """Who has asked for the releases that have passed their trials."""
    name = f"DORA_DATAFLOW_NAME={releases.cell.name}"
    lines = journalctl("-o", "json", name, "DORA_EVENT=release-committed").splitlines()
    return [json.loads(line)["DORA_BY"] for line in lines]


@pytest.mark.warns("was rolled back: the gateway was stopped", "exited with error: Signal(15)")
def test_a_gateway_that_is_stopped_ends_the_trial(
    browser: Browser, releases: Releases, project: Project, flag: Path
) -> None:
    del flag
    cell = releases.cell
    slow = f"import pathlib, time\nwhile pathlib.Path('{FLAG}').exists(): time.sleep(0.1)\n"
    write_version(project, "1", slow)
    releases.deploy(project.root, "--soak", "0s", "--grace-duration", "1s")
    first = releases.current()
    write_version(project, "2")
    releases.deploy(project.root, "--soak", "0s")
    second = releases.current()
    FLAG.touch()
    browser.wait_text(f"{row(first)} .badge", "Proved")
    confirm(browser, first)
    wait_for("it is on trial", lambda: cell.show("StatusText").startswith("0/1 nodes ready"))
    browser.wait_text(f"{row(first)} .badge", "Trial")
    run("systemctl", "stop", "dora-gateway.service")
    wait_for("it runs again", lambda: releases.running() == second)
    wait_for("it is up", lambda: cell.show("ActiveState") == "active")
    assert not releases.trial.exists()
    assert releases.current() == second
