"""The Debian packages: installed, used, upgraded, removed and purged, in this order.

Needs what `make deb` makes, in dist/, or the packages themselves with autopkgtest.
"""

import json
import os
import pwd
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from dora_systemd.errors import ExitCode
from tests.deb import packages
from tests.deb.packages import sh
from tests.system.cells import dora_processes, wait_for
from tests.system.shells import SHELLS

USERS = ("root", "alice")
ALICE = "XDG_RUNTIME_DIR=/run/user/$(id -u)"
MANUALS = (*sorted(path.name for path in (packages.CHECKOUT / "packaging/man").iterdir()), "dora.1")
COMPLETIONS = (
    "/usr/share/bash-completion/completions/doractl",
    "/usr/share/zsh/vendor-completions/_doractl",
    "/usr/share/fish/vendor_completions.d/doractl.fish",
)


@pytest.fixture(scope="module")
def before() -> set[str]:
    """The disk before the packages came; autopkgtest has installed them, the lab made a user."""
    if packages.AUTOPKGTEST:
        packages.apt("purge", "--yes", *packages.PACKAGES)
    sh("userdel dora 2>/dev/null || :")
    return packages.files()


@pytest.fixture(scope="module")
def flows() -> Iterator[dict[str, Path]]:
    """The robot of each user."""
    with packages.robot("root") as roots, packages.robot("alice") as hers:
        yield {"root": roots, "alice": hers}
        for user in USERS:
            sh("command -v doractl >/dev/null && doractl stop --all || :", user)


def main_pid(user: str, name: str = "robot") -> str:
    flag = "--system" if user == "root" else "--user"
    script = f"{ALICE} systemctl {flag} show --value --property=MainPID dora-{name}"
    return sh(script, user).stdout.strip()


def all_pids(user: str, name: str = "robot") -> list[str]:
    """Every process of the robot."""
    flag = "--system" if user == "root" else "--user"
    script = f"{ALICE} systemctl {flag} show --value --property=ControlGroup dora-{name}"
    group = Path(f"/sys/fs/cgroup{sh(script, user).stdout.strip()}")
    return sorted(pid for path in group.rglob("cgroup.procs") for pid in path.read_text().split())


def uuid(user: str, name: str = "robot") -> str:
    rows = json.loads(sh("doractl list -o json", user).stdout)
    (row,) = (row for row in rows if row["name"] == name)
    return str(row["uuid"])


def lines(user: str, node: str, name: str = "robot") -> list[str]:
    return sh(f"doractl logs {name} --node {node} -o cat", user, check=False).stdout.splitlines()


def wait_for_plot(user: str, seen: int = 0, name: str = "robot") -> None:
    try:
        wait_for(f"{user}'s {name} plots", lambda: len(lines(user, "plot", name)) > seen, 120)
    except AssertionError as error:
        raise AssertionError(f"{error}, after {seen} lines\n{last_words(user)}") from None


def last_words(user: str) -> str:
    """What a person would look at next."""
    looks = ("list", "top --once", "why robot", "logs robot --lines 60 -o short-precise")
    return "\n".join(sh(f"doractl {look} 2>&1", user, check=False).stdout for look in looks)


RESTART = "doractl restart robot"
ON_FAILURE = "--restart-policy on-failure"


def running_version(user: str) -> str:
    """What `list` says of the version that runs, "" if it is the installed one."""
    listed = sh("doractl list robot", user).stdout
    found = re.search(r"^Version: +(.*)$", listed, flags=re.MULTILINE)
    return found[1] if found else ""


def start(flows: dict[str, Path]) -> None:
    for user, flow in flows.items():
        sh(f"doractl start {flow} --name robot", user)


def test_install(before: set[str]) -> None:
    listening, running = packages.listeners(), packages.services()
    packages.install()
    assert packages.listeners() == listening, "the package opens no port"
    assert packages.services() == running, "the package starts no service"
    assert not dora_processes()
    assert sh("command -v doractl; command -v dora").stdout.split() == [
        "/usr/bin/doractl",
        "/usr/bin/dora",
    ]
    assert pwd.getpwnam("dora").pw_shell == "/usr/sbin/nologin"
    assert not any("dist-packages/dora_cli" in path for path in packages.files() - before)


def test_a_module_of_the_same_name_changes_nothing(tmp_path: Path) -> None:
    for name in ("click", "yaml", "dora_systemd", "re"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not that one')\n")
    sh(f"cd {tmp_path} && PYTHONPATH={tmp_path} PYTHONSTARTUP=click.py doractl list --all")


def test_versions_of_what_is_installed() -> None:
    versions = json.loads(sh("doractl version -o json").stdout)
    assert versions["dora"] == "1.1.0"
    assert versions["doractl"] == packages.version()


def test_units() -> None:
    for flags in ("--system", "--user"):
        user = "root" if flags == "--system" else "alice"
        show = f"{ALICE} systemctl {flags} show --value -p FragmentPath -p LoadState"
        kind = flags.removeprefix("--")
        for unit in ("dora.slice", "dora.target"):
            words = sh(f"{show} {unit}", user).stdout.split()
            assert "loaded" in words
            # That of systemd 252 begins with the link /lib.
            path = next(Path(one).resolve() for one in words if one.startswith("/"))
            assert path == Path(f"/usr/lib/systemd/{kind}/{unit}")
    sh("systemd-analyze verify --man=yes dora.slice dora.target")
    sh(f"{ALICE} systemd-analyze verify --user --man=yes dora.slice dora.target", "alice")
    assert "dora.target" in sh("systemctl list-dependencies --plain multi-user.target").stdout


def test_catalog() -> None:
    listed = sh("journalctl --list-catalog c8e3833d172d44c5a32de08c980c4d67").stdout
    assert "is running" in listed


@pytest.mark.parametrize("page", MANUALS)
def test_manuals(page: str) -> None:
    name, _, section = page.rpartition(".")
    path = sh(f"man --where {section} {name}").stdout.strip()
    assert path.startswith("/usr/share/man/")
    assert sh(f"man --warnings {section} {name}").stderr == ""
    lint = sh(f"mandoc -T lint -W style {path} 2>/dev/null || :").stdout.splitlines()
    assert [line for line in lint if "referenced manual not found" not in line] == []


def test_pages_link_what_is_there(tmp_path: Path) -> None:
    """In the package itself: images of containers leave /usr/share/doc out."""
    (package,) = (one for one in packages.find_packages() if "dora-systemd_" in one.name)
    sh(f"dpkg-deb --extract {package} {tmp_path}")
    place = tmp_path / "usr/share/doc/dora-systemd"
    pages = [*place.glob("README*.md"), *place.glob("docs/*.md")]
    assert {"README.md", "README.zh-CN.md", "install.md"} <= {page.name for page in pages}
    for page in pages:
        links = re.findall(r"\]\(([^)#:]+)[)#]", page.read_text())
        assert [link for link in links if not (page.parent / link).exists()] == [], page


def test_both_users_start_the_robot(flows: dict[str, Path]) -> None:
    start(flows)
    for user in USERS:
        (row,) = json.loads(sh("doractl list -o json", user).stdout)
        assert (row["name"], row["status"], row["nodes_alive"]) == ("robot", "Running", 3)
        wait_for_plot(user)
    assert "dora-robot.service" in sh("systemctl status dora.slice --no-pager").stdout
    assert "dora-robot.service" in sh(f"{ALICE} systemctl --user status dora.slice", "alice").stdout


def test_only_what_is_installed_runs() -> None:
    for user in USERS:
        owner = "dora" if user == "root" else "alice"
        pid = main_pid(user)
        assert sh(f"stat -c %U /proc/{pid}").stdout.strip() == owner
        words = sh(f"tr '\\0' ' ' </proc/{pid}/cmdline").stdout
        assert words.startswith("/usr/bin/python3 ")
        assert "--dora=/usr/bin/dora" in words.replace("--dora ", "--dora=")
    where = sh("python3 -c 'import dora_systemd; print(dora_systemd.__file__)'").stdout
    assert where.startswith("/usr/lib/python3/dist-packages/")


@pytest.mark.parametrize("path", COMPLETIONS)
def test_completions_are_there(path: str) -> None:
    assert Path(path).stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("user", USERS)
@pytest.mark.parametrize("shell", SHELLS)
def test_shells_complete_nodes_that_run(shell: str, user: str) -> None:
    found = SHELLS[shell]("doractl node restart robot d", packages.caller(user))
    assert found == ["detector"]


def test_upgrade_keeps_dataflows_running(tmp_path: Path, flows: dict[str, Path]) -> None:
    """What runs is not touched, enabled or deployed, and what is installed then works with it."""
    this = packages.version()
    packages.install(packages.build_previous(tmp_path))
    assert packages.version() == f"{this}~previous"
    for user in USERS:  # a runner newer than doractl
        assert running_version(user) == f"runs {this}, {this}~previous is installed: {RESTART}"
        sh("doractl node restart robot detector", user)
    sh("doractl enable robot && doractl restart robot")
    sh("doractl restart robot", "alice")
    sh(f"doractl deploy {flows['alice']} --name released --soak 0s", "alice")
    cells = [("root", "robot"), ("alice", "robot"), ("alice", "released")]
    before = {cell: (all_pids(*cell), uuid(*cell)) for cell in cells}
    packages.install()
    assert packages.version() == this
    assert {cell: (all_pids(*cell), uuid(*cell)) for cell in cells} == before
    for user in USERS:
        assert running_version(user) == f"runs {this}~previous, {this} is installed: {RESTART}"
    assert f"robot: runs {this}~previous" in sh("doractl doctor", check=False).stdout
    for user, name in cells:
        wait_for_plot(user, len(lines(user, "plot", name)), name)
        sh(f"doractl node restart {name} detector", user)
        wait_for_plot(user, len(lines(user, "plot", name)), name)
        assert main_pid(user, name) in before[user, name][0]
    sh("doractl restart robot && doractl disable robot")
    assert running_version("root") == ""
    sh("doractl disable released && doractl stop released", "alice")


OTHER = {"decisions/cell/options.py": ('"grace-duration"', '"grace-time"')}
"""A version whose command line of a runner this one does not know, and the reverse."""


def refused_restart(user: str) -> str:
    done = sh("doractl restart robot", user, check=False)
    assert done.returncode == ExitCode.BAD_INPUT
    assert "robot keeps running" in done.stderr
    return running_version(user)


def test_an_upgrade_that_changes_the_command_line(tmp_path: Path, flows: dict[str, Path]) -> None:
    """All verbs that do not start it work; after a crash `why` says what starts it again."""
    packages.install(packages.build_previous(tmp_path, OTHER))
    for user, flow in flows.items():
        assert "another version has started it" in refused_restart(user)
        sh(f"doractl stop robot && doractl start {flow} --name robot {ON_FAILURE}", user)
    packages.install()
    for user in USERS:
        assert "unknown argument '--grace-time=10s'" in refused_restart(user)
        sh("doractl node restart robot detector && doractl logs robot", user)
        os.kill(int(main_pid(user, "robot")), signal.SIGKILL)
        wait_for("its end", lambda: "Failed" in sh("doractl list --all", user).stdout)  # noqa: B023
        why = sh("doractl why robot", user, check=False).stdout
        assert "cannot read the runner's command line: unknown argument '--grace-time=10s'" in why
        todo = re.search(r"run: (doractl start --name robot \S+),", why)
        assert todo, why
        sh(todo[1], user)
        assert running_version(user) == ""


def test_stop_and_start_after_that(flows: dict[str, Path]) -> None:
    for user in USERS:
        assert "Dataflow stopped:" in sh("doractl stop robot", user).stdout
    wait_for("nothing runs", lambda: not dora_processes())
    start(flows)


CHECKED = Path("/etc/systemd/system/boot-complete.target.requires/dora-robot.service")


def test_an_installation_requires_again_what_a_boot_depended_on() -> None:
    """The removal below takes the link away, and nothing else of what is enabled."""
    sh("doractl enable robot --boot-check")
    target = CHECKED.readlink()
    CHECKED.unlink()
    for _ in range(2):
        sh("/var/lib/dpkg/info/dora-systemd.postinst configure 0.1.0")
        assert CHECKED.readlink() == target


def test_remove_stops_dataflows_and_leaves_configuration(before: set[str]) -> None:
    config = Path("/etc/dora-systemd/config.yml")
    config.write_text("grace_duration: 5s\n")
    sh("systemctl start dora.target")  # as after a boot
    packages.apt("remove", "--yes", *packages.PACKAGES)
    assert not dora_processes()
    assert sh("systemctl list-units --all --plain --no-legend 'dora[-.]*'").stdout == ""
    # The boot check of a dataflow that cannot start would fail, and the boot loader could go back.
    assert not CHECKED.is_symlink()
    unit = Path("/etc/systemd/system", CHECKED.name)
    enabled = (unit, unit.with_name("dora.target.wants") / unit.name)
    kept = (config, Path("/etc/needrestart/conf.d/50-dora-systemd.conf"), *enabled)
    assert left(before) == {str(path) for one in kept for path in (one, *one.parents[:-1])} - before


def test_purge_leaves_nothing(before: set[str]) -> None:
    enabled = Path("/etc/systemd/system/dora-kept.service")
    for unit in (enabled, enabled.with_name("doralink-kept:gpu.service")):
        unit.write_text("# Written by doractl(1). As enable --boot-check leaves it.\n")
    for place in ("dora.target.wants", "boot-complete.target.requires"):
        link = enabled.with_name(place) / enabled.name
        link.parent.mkdir(exist_ok=True)
        link.symlink_to(enabled)
    packages.apt("purge", "--yes", *packages.PACKAGES)
    assert left(before) == set()
    names = [entry.pw_name for entry in pwd.getpwall()]
    assert "dora" not in names
    assert Path("/etc/passwd").stat().st_mode & 0o777 == 0o644


def left(before: set[str]) -> set[str]:
    """What is on the disk now and was not; the robots of the tests are elsewhere."""
    return packages.files() - before
