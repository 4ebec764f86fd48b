"""`doractl doctor`: checks everything that a dataflow needs, with one function for each check.

Checks that need systemd are left out if it cannot be reached.
"""

import os
import pwd
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from dora_systemd.adapters.bus.manager import DOWN, Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.dora.command import (
    RECOMMENDED_DORA,
    dora_version,
    find_dora,
    version_numbers,
)
from dora_systemd.adapters.host.process import run_command
from dora_systemd.adapters.host.process_table import read_processes, socket_owners
from dora_systemd.adapters.host.real_time import read_real_time
from dora_systemd.adapters.host.rivals import Interrupts
from dora_systemd.adapters.journal import reader as journal_reader
from dora_systemd.decisions.cell.core_dumps import CORE_PATTERN, core_program
from dora_systemd.decisions.settings.table import USER
from dora_systemd.decisions.unit.file import BOOT_TARGET
from dora_systemd.decisions.unit.setup_files import PACKAGED_UNIT
from dora_systemd.decisions.views.diagnosis import (
    DORA_PORTS,
    Process,
    judge_controllers,
    judge_huge_pages,
    judge_port,
    judge_processes,
    judge_properties,
    judge_rate,
    judge_systemd,
)
from dora_systemd.decisions.views.findings import (
    Finding,
    Place,
    State,
    judge_cpuset,
    judge_journal,
    judge_real_time,
    storage_of,
)
from dora_systemd.decisions.views.upkeep import judge_core_pattern, judge_reboots, judge_stops
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import unit_name
from dora_systemd.scope import RUNTIME_NAME, Scope, scope_of
from dora_systemd.trust.files import read_file
from dora_systemd.trust.paths import exists
from dora_systemd.trust.programs import account_from
from dora_systemd.trust.sockets import TABLES, listening_sockets
from dora_systemd.verbs.facts.boot import judge_enabled
from dora_systemd.verbs.facts.cells import proven, read_cells
from dora_systemd.verbs.facts.enabled import enabled_units, lost_units, own_directories
from dora_systemd.verbs.facts.list import dataflow_row
from dora_systemd.verbs.facts.reading import slice_group
from dora_systemd.verbs.facts.stack import read_pattern
from dora_systemd.verbs.facts.waits import shared_interrupts
from dora_systemd.verbs.gateway import read_gateway
from dora_systemd.verbs.releases.listing import judge_releases
from dora_systemd.verbs.start.enable import boot_target
from dora_systemd.verbs.start.logins import PASSWD, is_lingering, judge_logins, linger_command
from dora_systemd.verbs.start.programs import unreadable_file, version_trouble_of
from dora_systemd.verbs.start.read import config_files, has_settings
from dora_systemd.verbs.start.settings import check_config
from dora_systemd.verbs.start.where import DEFAULT_USER, named_user

JOURNALD = "systemd-journald.service"

_SECONDS = 20.0
_STARTED = "ExecMainStartTimestamp"
_STOP = ("TimeoutStopUSec",)
_JOURNALD_CONFIG = ("systemd-analyze", "--no-pager", "cat-config", "systemd/journald.conf")
_COREDUMP_CONFIG = ("systemd-analyze", "--no-pager", "cat-config", "systemd/coredump.conf")
_PRESSURE = "proc/pressure"
_CONTAINER = "run/systemd/container"
"""systemd writes the kind of its container to this file, see systemd-detect-virt(1)."""
_BROKEN = ("bad-setting", "error")


def examine(
    reach: Callable[[Scope], Manager], scope: Scope, root: Path = Path("/")
) -> list[Finding]:
    """Yield all findings. reach: opens the connection to systemd. root: has all files."""
    version = ""
    try:
        manager = reach(scope)
        version = manager.version()
    except DoraSystemdError as error:
        found = [Finding("systemd", State.PROBLEM, error.message, error.hint)]
    else:
        found = [judge_systemd(version)]
        found += [one for check in _WITH_SYSTEMD for one in guarded(check, manager, scope, root)]
    found += [*_journal(reach, scope), *_stops(reach, scope)]
    found += [one for check in _WITHOUT for one in check(scope, root)]
    return [*found, *judge_properties(version)]


def guarded(
    check: Callable[[Manager, Scope, Path], Iterator[Finding]],
    manager: Manager,
    scope: Scope,
    root: Path,
) -> list[Finding]:
    """The findings of a check; its failure is one more."""
    topic = check.__name__.removeprefix("_").removeprefix("judge_")
    found: list[Finding] = []
    try:
        for one in check(manager, scope, root):
            found.append(one)
    except DoraSystemdError as error:
        found.append(Finding(topic, State.WARNING, error.message, error.hint))
    return found


def _controllers(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    try:
        group = cgroup.group_path(manager.control_group())
    except DoraSystemdError as error:  # no dataflow can start
        yield Finding("cgroup", State.PROBLEM, error.message, error.hint)
        return
    available = cgroup.read_controllers(group)
    yield judge_controllers(available, scope.is_user)
    yield judge_cpuset(available, scope.is_user)


def _linger(_manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    if not scope.is_user:
        return
    if is_lingering(scope):
        yield Finding("linger", State.OK, "dataflows keep running after logout and start at boot")
    else:
        text = "dataflows end when you log out, and none starts at boot"
        yield Finding("linger", State.WARNING, text, f"as root: {linger_command(scope)}")


def _boot(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    if boot_target(manager, scope) == BOOT_TARGET:
        yield Finding("boot", State.OK, f"{BOOT_TARGET} starts what is enabled")
    else:
        text = f"{BOOT_TARGET} is not set up; dataflows can be enabled without it"
        yield Finding("boot", State.NOTE, text, f"doractl {scope.flag} setup")
    directory = own_directories(manager, scope)[0]
    lost = lost_units(manager, scope)
    for unit in sorted(enabled_units(manager, scope)):
        findings = list(judge_enabled(directory / unit, scope))
        yield from findings
        if unit in lost and not findings:
            text = f"{unit} is enabled and systemd does not know it"
            yield Finding("boot", State.WARNING, text, f"systemctl {scope.flag} daemon-reload")


def _ports(manager: Manager, _scope: Scope, root: Path) -> Iterator[Finding]:
    gateway = read_gateway(manager)
    processes: list[Process] = []
    for port in DORA_PORTS:
        if gateway.is_up and gateway.port == port:
            yield Finding(f"port {port}", State.OK, "the gateway to all dataflows, see doractl env")
            continue
        sockets = listening_sockets(port, tuple(_below(root, one) for one in TABLES))
        owners = socket_owners(sockets, root / "proc") if sockets else frozenset()
        processes = processes or (read_processes(root / "proc") if owners else [])
        yield judge_port(port, [one for one in processes if one.pid in owners], bool(sockets))


def _units(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    for one in manager.list_units("dora-*.service"):
        if one.load in _BROKEN:
            text = f"{one.unit} cannot be loaded: {one.load}"
            remedy = f"systemd-analyze {scope.flag} verify {one.unit}"
            yield Finding("units", State.WARNING, text, remedy)


def _leftovers(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    left = [path for path in _cell_directories(scope) if _is_down(manager, unit_name(path.name))]
    for path in left:
        text = f"{path} belongs to no dataflow that runs"
        yield Finding("left over", State.WARNING, text, f"rm -r {path}")
    groups = [path for path in _unit_groups(manager) if _is_down(manager, path.name)]
    for path in groups:
        text = f"processes are left in {path}"
        yield Finding("left over", State.WARNING, text, f"as root: echo 1 > {path}/cgroup.kill")
    if not left and not groups:
        yield Finding("left over", State.OK, "nothing is left of dataflows that have ended")


def _cell_directories(scope: Scope) -> list[Path]:
    try:
        return sorted((scope.runtime_root / RUNTIME_NAME).iterdir())
    except OSError:
        return []


def _unit_groups(manager: Manager) -> list[Path]:
    paths = sorted(slice_group(manager).glob("dora-*.service"))
    return [path for path in paths if cgroup.is_populated(path)]


def _is_down(manager: Manager, unit: str) -> bool:
    return manager.read(unit, ["ActiveState"])["ActiveState"] in DOWN


def _journal(reach: Callable[[Scope], Manager], scope: Scope) -> Iterator[Finding]:
    try:
        config = run_command(_JOURNALD_CONFIG, _SECONDS).stdout
        rate = judge_rate(config, scope.is_user)
    except DoraSystemdError as error:
        config, rate = "", Finding("log rate", State.NOTE, error.message)
    place = _journal_place(reach)
    try:
        journal_reader.check_readable(scope)
    except DoraSystemdError as error:
        # Otherwise judge_journal() below reports the same problem.
        if place is Place.UNKNOWN or error.code is not ExitCode.NO_SYSTEMD:
            yield Finding("journal", State.WARNING, error.message, error.hint)
    yield judge_journal(place, storage_of(config))
    yield rate


def _journal_place(reach: Callable[[Scope], Manager]) -> Place:
    """Find where the system's journald has written since its start."""
    try:
        facts = reach(scope_of(is_user=False)).read(JOURNALD, ["ActiveState", _STARTED])
    except DoraSystemdError:
        return Place.UNKNOWN
    if facts["ActiveState"] in DOWN:
        return Place.STOPPED
    return journal_reader.place_since(int(facts[_STARTED]))


def _stops(reach: Callable[[Scope], Manager], scope: Scope) -> Iterator[Finding]:
    """Compare the stops of a user's dataflows with what systemd allows all services of a user."""
    if not scope.is_user:
        return
    with suppress(DoraSystemdError):
        manager = reach(scope)
        units = [(cell.name, cell.unit) for cell in proven(read_cells(manager))]
        stops = {name: manager.read(unit, _STOP)[_STOP[0]] for name, unit in units}
        of_user = f"user@{scope.uid}.service"
        allowed = reach(scope_of(is_user=False)).read(of_user, _STOP)[_STOP[0]]
        yield from judge_stops(stops, allowed)


def _dora(_scope: Scope, _root: Path) -> Iterator[Finding]:
    path = os.environ.get("PATH", os.defpath)
    try:
        dora = find_dora(None, os.environ.get("VIRTUAL_ENV"), path)
        version = dora_version(dora)
    except DoraSystemdError as error:
        yield Finding("dora", State.PROBLEM, error.message, error.hint)
        return
    if version_numbers(version) < RECOMMENDED_DORA:
        remedy = "pip install --upgrade dora-rs-cli"
        yield Finding("dora", State.NOTE, f"{dora} is {version}, older than recommended", remedy)
    else:
        yield Finding("dora", State.OK, f"{dora}, version {version}")


def _versions(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    """Compare the dora of nodes with that of their daemon, as their user sees the files.

    Also the version of each runner with this one.
    """
    for cell in proven(read_cells(manager)):
        text, remedy = dataflow_row(manager, scope, cell).upgrade
        if text:
            yield Finding("versions", State.NOTE, f"{cell.name}: {text}", remedy)
        try:
            text, remedy = version_trouble_of(manager, cell)
        except DoraSystemdError as error:  # of one dataflow, which must not hide the others
            text, remedy = error.message, error.hint
        if text:
            yield Finding("versions", State.WARNING, f"{cell.name}: {text}", remedy)


def _pressure(_scope: Scope, root: Path) -> Iterator[Finding]:
    if (root / CORE_PATTERN).exists() and not (root / _PRESSURE).exists():
        text = "the kernel does not measure what nodes wait for: top has no WAITS FOR"
        yield Finding("pressure", State.NOTE, text, "boot with psi=1")


def _huge_pages(_scope: Scope, root: Path) -> Iterator[Finding]:
    with suppress(OSError):
        mounts = (root / "proc/self/mounts").read_text(errors="replace")
        yield from judge_huge_pages(mounts, (root / "proc/sys/vm/nr_hugepages").read_text())


def _interrupts(manager: Manager, _scope: Scope, root: Path) -> Iterator[Finding]:
    """Compare the CPUs of nodes with those that handle the interrupts of their devices."""
    interrupts = Interrupts(root)
    for cell in proven(read_cells(manager)):
        for one in shared_interrupts(interrupts, cell.options):
            text = f"{cell.name}/{one.node}: cpus {one.cpus} also have {one}"
            yield Finding("interrupts", State.NOTE, text, one.remedy)


def _coredumps(_scope: Scope, root: Path) -> Iterator[Finding]:
    if not (root / CORE_PATTERN).exists():
        return
    pattern = read_pattern(root)
    program = core_program(pattern)
    is_there = not program or exists(_below(root, Path(program)))
    config = ""
    if program:
        with suppress(DoraSystemdError):
            config = run_command(_COREDUMP_CONFIG, _SECONDS).stdout
    yield judge_core_pattern(pattern, is_there, config, exists(root / _CONTAINER))


def _upgrades(_scope: Scope, root: Path) -> Iterator[Finding]:
    with suppress(OSError, DoraSystemdError):
        files = sorted((root / "etc/apt/apt.conf.d").iterdir())
        texts = (read_file(one).data.decode(errors="replace") for one in files)
        yield from judge_reboots("\n".join(texts))


def _user(scope: Scope, root: Path) -> Iterator[Finding]:
    if scope.is_user:
        return
    try:
        entry = pwd.getpwnam(DEFAULT_USER)
    except KeyError:
        yield judge_no_user(root)
        return
    text = f"{DEFAULT_USER} runs the dataflows of root's files"
    if closed := unreadable_file(account_from(entry)):
        remedy = f"see namei -l {closed}: chmod -R a+rX what is closed, such as pip makes it"
        remedy += " with umask 077, or install where all users can read"
        yield Finding("user", State.PROBLEM, f"{text}, and cannot read {closed}", remedy)
    else:
        yield Finding("user", State.OK, text)


def judge_no_user(root: Path) -> Finding:
    """The finding about a machine without the default user. root: has all files."""
    text = f"there is no user {DEFAULT_USER} to run the dataflows of root's files"
    # setup does nothing where a package is installed.
    how = "systemd-sysusers" if _below(root, Path(PACKAGED_UNIT)).exists() else "doractl setup"
    return Finding("user", State.NOTE, text, f"as root: {how}; or start them with --uid")


def _settings(scope: Scope, root: Path) -> Iterator[Finding]:
    """Check the settings files for all dataflows; `start` checks the one next to a dataflow."""
    for path in (_below(root, one) for one in config_files(os.environ)):
        try:
            if not has_settings(path):
                continue
            settings = check_config(scope, path)
            named_user(scope, settings[USER], settings.source(USER))
        except DoraSystemdError as error:
            yield Finding("settings", State.PROBLEM, error.message, error.hint)
        else:
            yield Finding("settings", State.OK, f"{path} can be read")


def _processes(_scope: Scope, root: Path) -> Iterator[Finding]:
    yield from judge_processes(read_processes(root / "proc"))


def _real_time(_scope: Scope, root: Path) -> Iterator[Finding]:
    yield from judge_real_time(read_real_time(root))


def _releases(manager: Manager, scope: Scope, _root: Path) -> Iterator[Finding]:
    return judge_releases(manager, scope)


def _logins(scope: Scope, root: Path) -> Iterator[Finding]:
    return judge_logins(scope, _below(root, PASSWD))


def _below(root: Path, path: Path) -> Path:
    return root / path.relative_to("/")


_OF_DATAFLOWS = (_units, _leftovers, _ports, _releases, _versions, _interrupts)
_WITH_SYSTEMD = (_controllers, _linger, _boot, *_OF_DATAFLOWS)
_OF_MACHINE = (_processes, _real_time, _pressure, _huge_pages, _coredumps, _upgrades)
_WITHOUT = (_dora, _user, _logins, _settings, *_OF_MACHINE)
