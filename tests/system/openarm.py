"""The example openarm: nodes of others, its dataset, and bare dora with the same dataflow."""

import http.client
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import yaml

from tests.lab.pace import bound
from tests.system.cells import Project, run, wait_for

CHECKOUT = Path(__file__).resolve().parents[2]
WHEELS = "/opt/openarm"
SIDES = ("right", "left")
STREAMS = tuple(f"{kind}/{side}" for kind in ("action", "obs") for side in SIDES)
CAMERAS = ("wrist_right", "wrist_left", "head_left", "ceiling")
SLOWER = {"millis/4\n": "millis/10\n", "millis/33\n": "millis/50\n", "960": "320", "600": "200"}
"""For two cores on which other tests run too."""
# What the lab has of what the nodes ask for, see tests/lab/openarm.py.
LOCAL = f"""
[tool.uv]
override-dependencies = ["opencv-python; python_version < '3'", "fastapi==0.165.0"]
environments = ["sys_platform == 'linux'"]
no-index = true
find-links = ["{WHEELS}"]
"""
UV = {"UV_OFFLINE": "1", "UV_PYTHON": "/usr/bin/python3"}
UI_PORT, BARE_PORT = 8000, 8001
STATE = Path("/var/lib/openarm")


class Episode(NamedTuple):
    """What a recorder has saved of an episode.

    rows: by stream, the count that the leader has given each. times: by stream and by camera, when
    each row or frame came, in nanoseconds.
    """

    rows: Mapping[str, list[int]]
    times: Mapping[str, list[int]]

    def counts(self) -> dict[str, int]:
        """How many rows or frames there are, by stream and camera."""
        return {name: len(times) for name, times in self.times.items()}

    def rates(self) -> dict[str, float]:
        """Rows or frames a second, by stream and camera."""
        return {
            name: (len(times) - 1) * 1e9 / (times[-1] - times[0])
            for name, times in self.times.items()
        }

    def lost(self) -> dict[str, int]:
        """How many of the leader's rows are not in a stream, between its first and its last."""
        return {
            name: sum(max(after - before - 1, 0) for before, after in pairwise(counts))
            for name, counts in self.rows.items()
        }


def write_project(project: Project) -> Path:
    """Copy the example with lower rates, and link the venv; returns the path of the dataflow."""
    for place in (CHECKOUT / "examples/openarm").iterdir():
        project.write(place.name, place.read_text())
    flow = project.root / "dataflow.yml"
    project.write("dataflow.yml", replaced(flow.read_text(), SLOWER))
    packages = project.root / "pyproject.toml"
    ours = {">=3.10": "==3.13.*", '"dora-rs': '"opencv-python-headless", "jinja2", "dora-rs'}
    project.write("pyproject.toml", replaced(packages.read_text(), ours) + LOCAL)
    # Compiled once: the user of the nodes cannot write there.
    run("uv", "sync", "--quiet", "--compile-bytecode", cwd=project.root, env={**os.environ, **UV})
    return flow


def replaced(text: str, words: Mapping[str, str]) -> str:
    """The text with each of these words replaced, which it has."""
    for old, new in words.items():
        assert old in text, old
        text = text.replace(old, new)
    return text


class Recorder:
    """The web page of a dataflow that runs, and the dataset that it writes."""

    def __init__(self, dataset: Path, port: int = UI_PORT) -> None:
        self.dataset = dataset
        self.port = port

    def post(self, command: str) -> None:
        """What a button of the page does."""
        status, _ = self._request("POST", f"/{command}")
        assert status == 303, f"{command}: {status}"

    def number(self) -> int:
        """The number of the episode that is recorded, or of the next one."""
        _, page = self._request("GET", "/")
        (found,) = re.findall(r"Episode: (\d+)", page)
        return int(found)

    def _request(self, method: str, path: str) -> tuple[int, str]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=bound(30))
        with closing(connection):
            connection.request(method, path)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()

    def wait_page(self) -> None:
        """Return when there is a page."""
        wait_for(f"a page at {self.port}", self._has_page)

    def _has_page(self) -> bool:
        try:
            return self._request("GET", "/")[0] == 200
        except OSError:
            return False

    def warm_up(self) -> None:
        """Return when all that the recorder writes of an episode comes; that one is cancelled."""
        self.wait_page()
        self.begin(40)
        self.post("cancel")

    def begin(self, count: int) -> int:
        """Begin an episode; return its number when it has `count` frames of each camera."""
        number = self.number()
        self.post("start")
        self.wait_frames(number, count)
        return number

    def end(self) -> int:
        """End the episode; return its number when it is in the dataset."""
        number = self.number()
        self.post("success")
        self.wait_listed(number)
        return number

    def wait_listed(self, number: int) -> None:
        """Return when an episode is in the dataset."""
        wait_for(f"episode {number} ends", lambda: number in self.listed())

    def wait_frames(self, number: int, count: int) -> None:
        """Return when the episode has `count` frames of each camera."""
        wait_for(
            f"{count} frames",
            lambda: all(len(self.frames(number, one)) >= count for one in CAMERAS),
            seconds=60,
        )

    def frames(self, number: int, camera: str) -> list[Path]:
        """The frames of an episode so far."""
        return sorted((self.dataset / f"episodes/{number}/cameras/{camera}").glob("*.jpeg"))

    def listed(self) -> list[int]:
        """The episodes that have been ended, as the dataset says.

        The recorder writes that file in place, so it can be empty for a moment.
        """
        place = self.dataset / "metadata.yaml"
        known = (yaml.safe_load(place.read_text()) if place.exists() else {}) or {}
        return [int(one["id"]) for one in known.get("episodes", ())]

    def is_open(self, number: int) -> bool:
        """Whether there are frames of the episode, and nothing that its end would have written.

        The recorder keeps the rows in memory until somebody ends the episode.
        """
        place = self.dataset / f"episodes/{number}"
        return {one.name for one in place.iterdir()} == {"cameras"}

    def read(self, number: int) -> Episode:
        """An episode that was ended; all of its files are complete."""
        assert number in self.listed()
        tables = {name: self._read_rows(number, name) for name in STREAMS}
        pictures = {one: self.frames(number, one) for one in CAMERAS}
        for place in (one for places in pictures.values() for one in places):
            data = place.read_bytes()
            assert data[:2] == b"\xff\xd8" and data[-2:] == b"\xff\xd9", place
        times = {name: [int(one.stem) for one in places] for name, places in pictures.items()}
        return Episode(
            {name: counts for name, (counts, _) in tables.items()},
            {**{name: when for name, (_, when) in tables.items()}, **times},
        )

    def _read_rows(self, number: int, stream: str) -> tuple[list[int], list[int]]:
        """The counts of the leader in a stream, and the time of each."""
        import pyarrow.parquet as parquet

        kind, side = stream.split("/")
        place = self.dataset / f"episodes/{number}/{kind}/arms/{side}/state.parquet"
        table = parquet.read_table(place)
        counts = [int(one[-1]) for one in table["qpos"].to_pylist()]
        return counts, table["timestamp"].cast("int64").to_pylist()


@contextmanager
def bare_dora(flow: Path, state: Path) -> Iterator[tuple[Recorder, subprocess.Popen[bytes]]]:
    """`dora run` of the same dataflow, whose page is at another port."""
    other = flow.with_name("bare.yml")
    other.write_text(replaced(flow.read_text(), {f"PORT: {UI_PORT}": f"PORT: {BARE_PORT}"}))
    venv = flow.parent / ".venv"
    places = {"VIRTUAL_ENV": str(venv), "PATH": f"{venv}/bin:{os.environ['PATH']}"}
    env = {**os.environ, **places, "STATE_DIRECTORY": str(state), "DATASET": "bare"}
    command = ["dora", "run", other.name]
    with subprocess.Popen(command, cwd=flow.parent, env=env, stdout=subprocess.DEVNULL) as dora:
        try:
            yield Recorder(state / "bare", BARE_PORT), dora
        finally:
            dora.send_signal(signal.SIGINT)
            dora.wait(bound(60))
            shutil.rmtree(state)
