"""The text of persistent unit files."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.file import (
    persistent_unit,
    runner_of,
    says_the_same,
    without_install,
)
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.errors import DoraSystemdError
from dora_systemd.paths import unit_directories
from tests.unit.fakes.manager import UUID, options

texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=30)
values = st.text(st.characters(exclude_categories=["Cc", "Cs"]), max_size=30)


def unit(runner: RunnerOptions, environment: dict[str, str], *properties: str) -> str:
    context = UnitContext("/usr/bin/python3", False, "dora", environment)
    settings = resolve_settings({"property": properties}, {}, [])
    return format_unit(unit_properties(runner, context, settings))


def persistent(runner: RunnerOptions, *more: str, target: str = "dora.target", **env: str) -> str:
    return persistent_unit([unit(runner, env), *more], runner, False, target)


@given(texts, texts, values)
def test_the_runner_is_found_again(dataflow: str, directory: str, value: str) -> None:
    """Whatever is in a path: the file's own command line says what the runner was told."""
    runner = options(dataflow=f"/{dataflow}", working_directory=f"/{directory}")
    text = persistent(runner, A=value)
    assert runner_of(text) == runner_of(text, can_start=True) == runner
    other = text.replace(" --name=", " --colour=red --name=", 1)
    assert (runner_of(other), runner_of(other, can_start=True)) == (runner, None)
    assert says_the_same(text, persistent(runner, A=value, target="multi-user.target"))
    assert not says_the_same(text, persistent(runner, A=f"{value}x"))


def test_sections_are_one_of_a_kind() -> None:
    drop_in = "# ours\n[Service]\nNice=5\n;x\n[Unit]\nAfter=a.service \\\n  b.service\n"
    text = persistent(options(), drop_in, "[Install]\nAlias=x.service\n", "ignored=1\n")
    assert text.count("[Service]") == text.count("[Unit]") == text.count("[Install]") == 1
    assert "\nAfter=a.service    b.service\n" in text.replace("\t", " ") or "b.service" in text
    assert "Alias" not in text
    assert "ignored" not in text
    assert "[Install]" not in without_install(text)


@pytest.mark.parametrize(
    ("target", "is_user", "lines"),
    [
        ("dora.target", False, ["RequiresMountsFor=/srv"]),
        ("multi-user.target", False, ["After=multi-user.target", "RequiresMountsFor=/srv"]),
        ("default.target", True, ["After=default.target"]),
    ],
)
def test_order_at_boot(target: str, is_user: bool, lines: list[str]) -> None:
    """No target waits for a dataflow."""
    text = persistent_unit([unit(options(), {})], options(), is_user, target)
    assert text.partition("\n\n")[0].splitlines()[3:] == lines
    assert persistent_unit([text], options(), is_user, target) == text


@pytest.mark.parametrize(
    ("directory", "line"),
    [
        ("/a b/c", 'RequiresMountsFor="/a b/c" /srv'),
        ("/a/../b//", "RequiresMountsFor=/b /srv"),
        ("/100%", "RequiresMountsFor=/100%% /srv"),
        ('/a"b', "RequiresMountsFor=/srv"),
    ],
)
def test_mounts(directory: str, line: str) -> None:
    runner = options(dataflow=f"{directory}/robot.yml")
    assert f"\n{line}\n" in persistent(runner)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[Service]",
        "[Service]\nExecStart=",
        "[Service]\nExecStart=/bin/sleep 1",
        "[Service]\nExecStart='/bin",
        "[Unit]\nExecStart=/usr/bin/python3 -m dora_systemd.runner --name=a /b",
    ],
)
def test_what_is_not_ours(text: str) -> None:
    assert runner_of(text) is None


SYSTEMDS_OWN = f"""\
# This is a transient unit file, created programmatically via the systemd API. Do not edit.
[Unit]
Description=dora dataflow robot

[Service]
ExecStart=
ExecStart=:"/usr/bin/python3" "-E" "-P" "-m" "dora_systemd.runner" "--name=robot" \
"--uuid={UUID}" "--working-directory=/srv" "--dora=/bin/dora" "--grace-duration=10s" \
"/srv/robot.yml"
LimitMEMLOCK=infinity
LimitMEMLOCK=infinity
Environment="A=x \\"y\\" $HOME %%h \\303\\251 \\\\ z\\\\n"
LimitNOFILE=1000
LimitNOFILE=1000:2000

[Unit]
After=foo.service
ConditionHost=!x

[Service]
SystemCallFilter=~@mount
"""
OUR_OWN = f"""\
[Unit]
Description=dora dataflow robot
After=foo.service
ConditionHost=!x
[Service]
ExecStart=:/usr/bin/python3 -E -P -m dora_systemd.runner --name=robot --uuid={UUID} \
--working-directory=/srv --dora=/bin/dora --grace-duration=10s /srv/robot.yml
LimitMEMLOCK=infinity
Environment="A=x \\"y\\" $HOME %%h é \\\\ z\\\\n"
LimitNOFILE=1000:2000
SystemCallFilter=~@mount
"""


def test_systemds_own_spelling() -> None:
    """As systemd 257 writes a transient unit."""
    assert runner_of(SYSTEMDS_OWN) == options()
    assert says_the_same(SYSTEMDS_OWN, OUR_OWN)


@pytest.mark.parametrize(
    ("line", "quoted"),
    [
        ("BindReadOnlyPaths=/a b:/a b:rbind", 'BindReadOnlyPaths="/a b":"/a b"'),
        ("BindPaths=-/a b:/c  d:norbind", 'BindPaths="-/a b":"/c  d":norbind'),
        ('BindPaths=/100%% "x" \\:/y:rbind', 'BindPaths="/100%% \\"x\\" \\\\":/y'),
        ("BindPaths=/a:/b:norbind", "BindPaths=/a:/b:norbind"),
        ("BindPaths=", "BindPaths="),
    ],
)
def test_systemds_own_bind_mounts(line: str, quoted: str) -> None:
    """It writes them as they are; what doractl has written is right as it is."""
    assert f"\n{quoted}\n" in persistent_unit(
        [f"{SYSTEMDS_OWN}\n[Service]\n{line}\n"], options(), False, "dora.target"
    )
    assert f"\n{line}\n" in persistent_unit([f"{OUR_OWN}{line}\n"], options(), False, "dora.target")


@pytest.mark.parametrize("line", ["Nice=5", "User=%u", "Unheard=1", "Nice=x"])
def test_edited_by_hand(line: str) -> None:
    assert not says_the_same(f"{OUR_OWN}{line}\n", OUR_OWN)


SYSTEM: Any = ["/etc/systemd/system.control", "/run/systemd/transient", "/etc/systemd/system"]
USER: Any = ["/home/a/.config/systemd/user", "/etc/systemd/user", "/run/user/1000/systemd/user"]


def test_directories() -> None:
    more = ["/run/systemd/system", "/usr/lib/systemd/system"]
    assert unit_directories([*SYSTEM, *more], False, "/run") == (
        "/etc/systemd/system",
        "/run/systemd/system",
    )
    assert unit_directories(USER, True, "/run/user/1000") == (USER[0], USER[2])
    with pytest.raises(DoraSystemdError, match="systemd/user"):
        unit_directories(SYSTEM, True, "/run/user/1000")


def test_networks_in_another_order_are_the_same() -> None:
    head = "[Service]\n"
    ours = f"{head}IPAddressDeny=0.0.0.0/0 ::/0\nSystemCallErrorNumber=EPERM\n"
    systemds = f"{head}IPAddressDeny=\nIPAddressDeny=::/0\nIPAddressDeny=0.0.0.0/0\n"
    assert says_the_same(ours, f"{systemds}SystemCallErrorNumber=1\n")
    assert not says_the_same(ours, f"{head}IPAddressDeny=::/0\nSystemCallErrorNumber=1\n")
