"""Writes the units that `doractl start --dry-run` prints for the examples, with all settings.

    python3 -m tests.dry_runs

tests/unit/verbs/start/test_dry_runs.py compares: code that moves leaves a unit as it is, byte for
byte. Each unit is that of a user's manager of systemd 257.
"""

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from dora_systemd import scope
from dora_systemd.verbs.start.plan import make_plan
from dora_systemd.verbs.start.request import StartRequest
from dora_systemd.verbs.start.unit import format_plan
from tests.unit.checkout import CHECKOUT
from tests.unit.fakes.manager import UUID, FakeManager
from tests.unit.fakes.programs import make_dora, make_program

UNITS = CHECKOUT / "tests/unit/verbs/start/units"


@dataclass(frozen=True)
class Case:
    """A start. The files are those of an example, and more texts by name."""

    example: str
    files: Mapping[str, str] = field(default_factory=dict)
    flags: Mapping[str, object] = field(default_factory=dict)


_SETTINGS = """
env: {MODEL: yolo, TEXT: 'a "b" $c %d'}
grace_duration: 5s
uv: yes
allow_shell_nodes: yes
exit_when_nodes_finish: no
cpu_limit: 1.5
memory_limit: 4G
tasks_limit: 500
log_rate_limit: 1000/1s
restart_policy: on-failure
max_restarts: 3
start_timeout: 1min
stop_limit: 10min
watchdog: 5s
notify: yes
on_failure: [notify, --urgent]
record: {last: 30s, memory: 200M, outputs: [camera/image]}
hot_reload: yes
watch: ['*.py']
ignore: ['draft_*']
needs: ['unit:x.service']
property: {Environment: A=b, Nice: 5}
nodes:
  camera:
    memory_limit: 1G
    cpus: 0,2-3
    needs: [/dev/video0, 'net:can0']
    owes: {output: image, within: 2s}
    stop: {within: 20s, after: [detector]}
    replace: start-first
    essential: yes
  detector:
    log_rate_limit: 9/1s
    watchdog: 2s
    watch: ['*.toml']
    scheduling: batch
    nice: 5
    oom_score_adjust: 300
    core_dumps: no
    owes: [{output: boxes, within: 1s, then: warn}]
  plot: {restart_policy: always, max_restarts: 9, notify: no}
"""
_MACHINES = """
machines: {gpu: {host: alice@gpu-box, directory: /home/alice, memory_limit: 8G, env: {A: b}}}
watchdog: 5s
nodes: {detector: {memory_limit: 1G, essential: yes}, camera: {nice: 5}}
"""
_PLACED = (
    (CHECKOUT / "examples/robot/dataflow.yml")
    .read_text()
    .replace("id: detector", "id: detector\n    deploy: {machine: gpu}")
)
CASES = {
    "robot": Case("robot"),
    "arm": Case("arm"),
    "openarm": Case("openarm"),
    "settings": Case("robot", {"dataflow.systemd.yml": _SETTINGS}),
    "flags": Case(
        "arm",
        {"secret": "x", "dataflow.systemd.yml": "credentials: {key: secret}\nwritable: secret\n"},
        {"debug": True, "sandbox": "strict", "network": "loopback", "env": ("B=c",), "nice": "3"},
    ),
    "machines": Case("robot", {"dataflow.systemd.yml": _MACHINES, "dataflow.yml": _PLACED}),
}


def dry_run(case: Case, place: Path) -> str:
    """The text of the unit. place: an empty directory for the files."""
    project = shutil.copytree(CHECKOUT / "examples" / case.example, place / case.example)
    for name, text in case.files.items():
        (project / name).write_text(text)
    programs = place / "bin"
    make_dora(programs / "dora", "1.1.0")
    nodes = yaml.safe_load((project / "dataflow.yml").read_text())["nodes"]
    for name in ("python3", "uv", "notify", *(node["path"] for node in nodes)):
        if not (project / name).exists():
            make_program(programs / name)
    variables = {"PATH": f"{programs}:/usr/bin:/bin", "HOME": str(place)}
    file = str(project / "dataflow.yml")
    manager = FakeManager()
    user = scope.Scope(is_user=True, uid=1000)
    plan = make_plan(user, StartRequest(file, "it", dict(case.flags), variables, uuid=UUID))
    return _everywhere(format_plan(plan, lambda: manager), place)


def _everywhere(text: str, place: Path) -> str:
    """The text as it is on every machine."""
    package = str(Path(scope.__file__).parents[1])
    own = {str(place): "/srv", package: "/opt/dora-systemd", sys.executable: "/opt/python3"}
    for here, there in own.items():
        text = text.replace(here, there)
    return re.sub(r"--head=[^ ]+", "--head=robot-1", text)


def main() -> None:
    """Write all of them."""
    UNITS.mkdir(exist_ok=True)
    for name, case in CASES.items():
        with tempfile.TemporaryDirectory() as place:
            (UNITS / f"{name}.txt").write_text(dry_run(case, Path(os.path.realpath(place))))


if __name__ == "__main__":
    main()
