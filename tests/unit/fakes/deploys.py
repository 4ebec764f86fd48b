"""A project that is deployed in user scope: files and a store, and a systemd of a few dicts."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Property
from dora_systemd.adapters.releases.store import Store
from dora_systemd.decisions.releases.progress import Step
from dora_systemd.decisions.unit.file import runner_of
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.enabled import trial_path
from dora_systemd.verbs.facts.locks import IfInhibited
from dora_systemd.verbs.releases.deploy import Deployed, DeployRequest, deploy
from dora_systemd.verbs.releases.listing import read_releases, store_of
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.manager import PrintingManager, ScopeIn
from tests.unit.fakes.programs import make_dora

UNIT = "dora-robot.service"
FLOW = "nodes: [{id: a, path: a.py}]\n"
VERSIONS = b"versions: dora=1.1.0 python=3.12.1\n"


class Systemd(PrintingManager):
    """A start loads the unit file with the highest precedence. state: of what is on trial.

    TREE in what a check says stands for the directory of its dataflow. on_start: called at each
    start.
    """

    on_start: Callable[[], None] = staticmethod(lambda: None)

    def __init__(self, root: Path, scope: Scope) -> None:
        super().__init__(VERSIONS)
        self.etc, self.kind, self.state, self.lives = root / "etc", "user", "active", 0
        self.paths = [trial_path(scope, UNIT), self.etc / "systemd/user" / UNIT]

    def start_transient(
        self, unit: str, properties: Sequence[Property], *how: Any, **more: Any
    ) -> str:
        (command,) = next(value for name, _, value in properties if name == "ExecStart")
        template = self.said
        self.said = template.replace(b"TREE", os.fsencode(Path(command[1][-1]).parent))
        try:
            return super().start_transient(unit, properties, *how, **more)
        finally:
            self.said = template

    def queue_job(self, method: str, unit: str) -> str:
        job = super().queue_job(method, unit)
        path = next(one for one in self.paths if one.exists())
        options = runner_of(path.read_text())
        assert options is not None
        state = self.state if path == self.paths[0] else "active"
        self.lives += 1
        facts = {"Transient": False, "FragmentPath": str(path), "InvocationID": bytes([self.lives])}
        self.add(options, state, **facts)
        if self.paths[1].exists():
            self.hold(unit)
        self.on_start()
        return job


class Bench:
    """A project that is deployed again and again.

    how: of its deploys; FORCE, since most tests deploy what has not changed.
    """

    how = IfInhibited.FORCE

    def __init__(self, root: Path) -> None:
        self.scope = ScopeIn(is_user=True, uid=os.geteuid(), root=root / "run")
        self.manager = Systemd(root, self.scope)
        self.project = root / "project"
        self.project.mkdir()
        self.dora = make_dora(root / "bin/dora", "1.1.0")
        self.steps: list[Step] = []
        self.warnings: list[str] = []
        self.write("dataflow.yml", FLOW)
        self.write("a.py", "")

    @property
    def store(self) -> Store:
        return store_of(self.scope, "robot")

    def write(self, name: str, text: str) -> None:
        (self.project / name).write_text(text)

    def fail(self, reason: str) -> None:
        raise DoraSystemdError(reason)

    def start(self, **flags: object) -> StartRequest:
        given = {"dora": self.dora, **flags}
        return StartRequest(str(self.project), name="robot", flags=given)

    def deploy(self, keep: int = 3, want_boot: bool = True, **flags: object) -> Deployed:
        """Deploy the project as it is now; `steps` and `warnings` are those of this deploy."""
        self.steps.clear()
        self.warnings.clear()
        tell, warn = self.steps.append, self.warnings.append
        return deploy(self.manager, self.scope, self.request(keep, want_boot, **flags), tell, warn)

    def request(self, keep: int = 3, want_boot: bool = True, **flags: object) -> DeployRequest:
        return DeployRequest(self.start(**flags), 0, keep, want_boot, self.how)

    @property
    def releases(self) -> dict[str, str]:
        """The state of each release, oldest first."""
        rows = read_releases(self.manager, self.scope, ["robot"])
        return {row.id: row.state for row in reversed(rows)}

    @property
    def texts(self) -> list[str]:
        """What has been told, each once."""
        return list(dict.fromkeys(one.text for one in self.steps))
