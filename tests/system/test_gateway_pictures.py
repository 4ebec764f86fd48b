"""The last pictures of cameras on the status page: of the memory of a recorder, and of a bundle."""

import json
import os
import shutil
import signal
import tarfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.system.cells import TICK, Cell, Project, wait_for
from tests.system.chromium import Browser
from tests.system.gateways import Front
from tests.system.pages import look
from tests.system.test_gateway_past import PHONE, STORE

pytestmark = [pytest.mark.lab, pytest.mark.browser, pytest.mark.usefixtures("gateway_up")]

CAMERA = """
from dora import Node
import pyarrow as pa
node = Node()
broken = bytes.fromhex("ffd8ffc0001108000400040301") + bytes(9)
for event in node:
    if event["type"] == "INPUT":
        rgb = pa.array([200, 30, 40] * 8, type=pa.uint8())
        node.send_output("image", rgb, {"encoding": "rgb8", "width": 4, "height": 2})
        node.send_output("broken", pa.array(list(broken), type=pa.uint8()), {"encoding": "jpeg"})
        node.send_output("count", pa.array([1]))
"""
FLOW = (
    f"nodes: [{{id: camera, path: camera.py, inputs: {{tick: {TICK}}},"
    " outputs: [image, broken, count]}]\n"
)
PIXEL = """
(() => {
  const copy = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
  copy.drawImage(document.querySelector('.pictures [data-output="camera/image"] canvas'), 0, 0);
  return [...copy.getImageData(1, 1, 1, 1).data].join();
})()
"""
BROKEN = '.pictures [data-output="camera/broken"]'


@pytest.fixture
def path(project: Project, cell: Cell) -> Iterator[Path]:
    project.write("camera.py", CAMERA)
    yield project.write("dataflow.yml", FLOW)
    shutil.rmtree(STORE / cell.name, ignore_errors=True)


def heads(front: Front, uuid: str) -> list[dict[str, Any]]:
    """What the page receives of the pictures besides their bytes."""
    with urllib.request.urlopen(f"http://127.0.0.1:{front.port}/pictures/{uuid}") as answer:
        found = json.loads(answer.readline())
        assert len(answer.read()) == sum(one["size_bytes"] for one in found)
    assert isinstance(found, list)
    return found


def test_the_last_picture_of_a_camera(
    browser: Browser, cell: Cell, path: Path, front: Front
) -> None:
    cell.start(path, "--record", "yes")
    uuid = cell.status.uuid
    wait_for("both are recorded", lambda: len(heads(front, uuid)) == 2)
    browser.open(f"http://127.0.0.1:{front.port}/?later#{uuid}")
    browser.wait_text(".pictures", "from the memory of the recorder")
    browser.wait_js(f"({PIXEL}) === '200,30,40,255'")
    browser.wait_text(BROKEN, "cannot be shown")
    assert "count" not in browser.text(".pictures")
    browser.wait_text(".graph", "camera")
    assert "dora-systemd" not in browser.text(".graph"), "the recorder is none of its nodes"
    look(browser, "pictures")
    browser.resize(*PHONE, is_phone=True)
    browser.wait_js("document.documentElement.scrollWidth === 320")
    look(browser, "pictures-phone")
    # The same door as that of the page.
    assert front.get(f"/pictures/{uuid}", user="alice").status == 401
    assert front.get(f"/pictures/{uuid}", "-H", "Origin: http://elsewhere").status == 403
    assert front.get("/pictures/camera").status == 404
    # systemd lets go of the memory, and the bundle stays.
    cell.doractl("bundle", cell.name)
    cell.doractl("stop", cell.name)
    (file,) = (STORE / cell.name).iterdir()
    browser.wait_text(".pictures", f"from the bundle {file.name}", 90)
    browser.wait_js(f"({PIXEL}) === '200,30,40,255'")
    assert {one["bundle"] for one in heads(front, uuid)} == {file.name}
    link = "document.querySelector('.pictures a')"
    size = browser.js(f"fetch({link}.href).then((a) => a.blob()).then((one) => one.size)")
    assert size == file.stat().st_size
    assert browser.failures() == []


def test_what_the_page_writes_has_the_recording(
    browser: Browser, cell: Cell, path: Path, front: Front
) -> None:
    """The gateway of the system can read the memory of a recorder, whatever the sandbox is."""
    cell.start(path, "--record", "yes", "--sandbox", "none")
    wait_for("it is recorded", lambda: heads(front, cell.status.uuid))
    browser.click("#detail [data-action=bundle]")
    browser.click("#confirmed")
    browser.wait_text("#said", "Bundle written", 60)
    (file,) = (STORE / cell.name).iterdir()
    with tarfile.open(file) as archive:
        assert "recording.mcap" in archive.getnames()


@pytest.mark.warns("killed", "signal", "SIGKILL", "failed", "Failed with result")
def test_the_memory_outlives_the_supervisor_process(cell: Cell, path: Path, front: Front) -> None:
    cell.start(path, "--record", "yes", "--sandbox", "none", "--restart-policy", "no")
    uuid = cell.status.uuid
    wait_for("it is recorded", lambda: heads(front, uuid))
    os.kill(int(front.show("MainPID", cell.unit)), signal.SIGKILL)
    wait_for("it has failed", lambda: front.show("ActiveState", cell.unit) == "failed")
    assert {one["bundle"] for one in heads(front, uuid)} == {None}


def test_without_a_recorder_there_is_nothing(
    browser: Browser, cell: Cell, path: Path, front: Front
) -> None:
    cell.start(path)
    assert heads(front, cell.status.uuid) == []
    browser.wait_text("#detail .nodes", "camera")
    assert not browser.js("document.querySelector('.pictures').checkVisibility()")
