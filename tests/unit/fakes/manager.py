"""A systemd of a few dicts: what the use cases of doractl are tested against."""

import os
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Self

from dora_systemd.adapters.bus.manager import JOB_DONE, Beside, Observer, Property, UnitState
from dora_systemd.decisions.cell.limits import BY_KEY, NodeLimits
from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    SettingText,
    parse_setting,
    runner_command,
)
from dora_systemd.decisions.cell.owes import Owed, format_owed
from dora_systemd.decisions.cell.restarts import POLICY_KEYS, RestartPolicy
from dora_systemd.decisions.cell.rights import NodeRights, given_rights
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_description, unit_name
from dora_systemd.scope import Scope
from dora_systemd.values import format_duration, format_number, scalar_text


class ScopeIn(Scope):
    """A scope whose runtime directories are below `root`, and its state in `root` / state."""

    root: Path

    def __new__(cls, is_user: bool, uid: int, root: Path = Path("/nowhere")) -> Self:
        self = super().__new__(cls, is_user, uid)
        self.root = root
        return self

    @property
    def runtime_root(self) -> Path:
        return self.root

    @property
    def state_root(self) -> Path:
        return self.root / "state"


UUID = "550e8400-e29b-41d4-a716-446655440000"


def options(name: str = "robot", uuid: str = UUID, **more: Any) -> RunnerOptions:
    """What a runner of that name was told."""
    values = {"dataflow": f"/srv/{name}.yml", "working_directory": "/srv", "dora": "/bin/dora"}
    return RunnerOptions(name=name, uuid=uuid, **{**values, **more})


def with_texts(options: RunnerOptions, *texts: str) -> RunnerOptions:
    """The options with [NODE:]KEY=TEXT."""
    return options._replace(settings=(*options.settings, *map(parse_setting, texts)))


def with_limits(options: RunnerOptions, *limits: NodeLimits) -> RunnerOptions:
    given = ((one.node, BY_KEY[key], value) for one in limits for key, value in one.limits)
    return _with(options, (SettingText(n, one.key, one.format(value)) for n, one, value in given))


def with_rights(options: RunnerOptions, *rights: NodeRights) -> RunnerOptions:
    given = ((one.node, key, value) for one in rights for key, value in given_rights(one).items())
    return _with(options, (SettingText(n, key, scalar_text(v)) for n, key, v in given))


def with_owes(options: RunnerOptions, *owes: Owed) -> RunnerOptions:
    return _with(options, (SettingText(one.node, "owes", format_owed(one)) for one in owes))


def with_restart(options: RunnerOptions, policy: RestartPolicy, node: str = "") -> RunnerOptions:
    texts = (
        policy.policy,
        format_number(policy.max_restarts),
        *map(format_duration, (policy.window, policy.delay, policy.max_delay)),
    )
    given = zip(POLICY_KEYS, texts, strict=True)
    return _with(options, (SettingText(node, *one) for one in given))


def _with(options: RunnerOptions, texts: Iterable[SettingText]) -> RunnerOptions:
    return options._replace(settings=(*options.settings, *texts))


class FakeManager:
    """Units by name with their properties; every change that is asked for is in `calls`.

    questions: how many a Bus would have asked. job_results: by unit, what its jobs end with.
    on_start: is called with each new unit's facts.
    """

    def __init__(self) -> None:
        self.units: dict[str, dict[str, Any]] = {}
        self.calls: list[tuple[Any, ...]] = []
        self.job_results: dict[str, str] = {}
        self.stages: list[str] = []
        self.held: set[str] = set()
        self.unloaded: list[str] = []
        self.after_job: dict[str, dict[str, Any]] = {}
        self.systemd = "257.13-1"
        self.types: dict[str, str] = {}
        self.questions = 0
        self.etc, self.kind = Path("/nowhere/etc"), "system"

    def add(self, runner: RunnerOptions, active: str = "active", **facts: Any) -> str:
        """A unit of ours in state `active`."""
        unit = unit_name(runner.name)
        command = runner_command("/usr/bin/python3", runner)
        self.units[unit] = {
            "LoadState": "loaded",
            "ActiveState": active,
            "SubState": "running",
            "Description": unit_description(runner.name, runner.uuid),
            "Transient": True,
            "FragmentPath": f"/run/systemd/transient/{unit}",
            "ExecStart": [[command[0], command, False, 0, 0, 0, 0, 0, 0, 0]],
            "ControlGroup": "",
            "NRestarts": 0,
            "Restart": "no",
            "StartLimitBurst": 5,
            "StartLimitIntervalUSec": 10_000_000,
            "StatusText": "",
            "Result": "success",
            "ExecMainCode": 1,
            "ExecMainStatus": 0,
            "ActiveEnterTimestamp": 0,
            "ExecMainStartTimestamp": 0,
            "ActiveEnterTimestampMonotonic": 0,
            "InactiveExitTimestamp": 0,
            "InactiveExitTimestampMonotonic": 0,
            "Job": [0, "/"],
            "UID": 1000,
            "PrivateNetwork": False,
            **facts,
        }
        return unit

    def list_units(self, pattern: str) -> list[UnitState]:
        self.questions += 1
        return [
            UnitState(
                *(unit, facts["LoadState"], facts["ActiveState"], facts["SubState"]),
                facts["Description"],
                facts.get("JobType", ""),
            )
            for unit, facts in self.units.items()
            if fnmatch(unit, pattern)
        ]

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        unknown: dict[str, Any] = {"LoadState": "not-found", "ActiveState": "inactive"}
        facts = self.units.get(unit, unknown)
        self.questions += len(names)
        return {name: facts.get(name, "") for name in names}

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        self.calls.append(("start", unit, wait))
        for name, of_it in beside:
            self.units[name] = {"LoadState": "loaded", "ActiveState": "active"}
            self.units[name] |= {key: value for key, _, value in of_it}
        self._tell(observer)
        self.units.setdefault(unit, {"LoadState": "loaded", "ActiveState": "active"})
        self.units[unit] |= {name: value for name, _, value in properties}
        return self._end(unit)

    def run_jobs(
        self, method: str, units: Sequence[str], observer: Observer | None = None
    ) -> dict[str, str]:
        self.calls.append((method, *units))
        self._tell(observer)
        return {unit: self._end(unit) for unit in units}

    def queue_job(self, method: str, unit: str) -> str:
        self.calls.append((method, unit))
        if unit in self.units:
            self.units[unit]["Job"] = [0, "/"]  # it is done at once
        return "/job"

    def kill(self, unit: str, signal: int, whom: str = "all") -> None:
        self.calls.append(("kill", unit, signal, whom))

    def thaw(self, unit: str) -> bool:
        is_frozen = bool(self.units.get(unit, {}).pop("FreezerState", ""))
        self.calls += [("thaw", unit)] if is_frozen else []
        return is_frozen

    def reset_failed(self, unit: str) -> None:
        if unit not in self.units:
            raise DoraSystemdError(f"cannot reset {unit}", "", ExitCode.NOT_FOUND)
        self.calls.append(("reset", unit))
        self.units[unit]["NRestarts"] = 0
        if unit not in self.held and self.units[unit]["ActiveState"] != "active":
            del self.units[unit]

    def close_stored(self, unit: str) -> None:
        self.calls.append(("close", unit))
        self.units[unit].update(Transient=False, NFileDescriptorStore=0)

    def hold(self, unit: str) -> None:
        self.held.add(unit)

    def unload(self, unit: str) -> None:
        self.unloaded.append(unit)

    def set_properties(self, unit: str, properties: Sequence[Property], runtime: bool) -> None:
        self.calls.append(("set", unit, list(properties), runtime))

    def fileno(self) -> int:
        return 0

    def changes(self, unit: str) -> list[Mapping[str, Any]]:
        del unit
        return []

    def awaited(self, unit: str) -> list[str]:
        self.questions += 2
        found: list[str] = self.units[unit].get("Awaited", [])
        return found

    def began_us(self) -> int:
        self.questions += 1
        return 1

    def control_group(self) -> str:
        self.questions += 1
        return ""

    def reload(self) -> None:
        self.calls.append(("reload",))

    def unit_path(self) -> list[str]:
        self.questions += 1
        return [f"{self.etc}/systemd/{kind}" for kind in ("system", "user")]

    def enable_unit_files(self, names: Sequence[str]) -> bool:
        self.calls.append(("enable", *names))
        for name in names:
            wants = self.etc / "systemd" / self.kind / "dora.target.wants"
            wants.mkdir(parents=True, exist_ok=True)
            link = wants / Path(name).name
            link.unlink(missing_ok=True)
            link.symlink_to(self.etc / "systemd" / self.kind / link.name)
        return True

    def disable_unit_files(self, units: Sequence[str]) -> None:
        self.calls.append(("disable", *units))
        for unit in units:
            for link in self.etc.glob(f"systemd/*/*.wants/{unit}"):
                link.unlink()

    def version(self) -> str:
        return self.systemd

    def property_types(self) -> dict[str, str]:
        return self.types

    def _tell(self, observer: Observer | None) -> None:
        for stage in self.stages:
            if observer:
                observer({"StatusText": stage})

    def _end(self, unit: str) -> str:
        self.units[unit] |= self.after_job.get(unit, {})
        return self.job_results.get(unit, JOB_DONE)


class PrintingManager(FakeManager):
    """A manager whose units print `said` and `refusal`, and end with `status`."""

    def __init__(self, said: bytes = b"", status: int = 0, refusal: bytes = b"") -> None:
        super().__init__()
        self.said, self.status, self.refusal = said, status, refusal
        self.given: dict[str, Any] = {}  # properties of the last unit, by name

    def start_transient(
        self,
        unit: str,
        properties: Sequence[Property],
        observer: Observer | None,
        wait: bool,
        beside: Beside = (),
    ) -> str:
        self.given = {name: value for name, _, value in properties}
        os.write(self.given["StandardOutputFileDescriptor"], self.said)
        if self.refusal:
            os.write(self.given["StandardErrorFileDescriptor"], self.refusal)
        self.after_job[unit] = {"ActiveState": "inactive", "Job": (0, "/")}
        self.after_job[unit] |= {"ExecMainCode": 1, "ExecMainStatus": self.status}
        return super().start_transient(unit, properties, observer, wait, beside)
