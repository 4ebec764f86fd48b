"""The sandbox: what each level and choice becomes, and that nothing contradicts itself."""

import os
import pwd
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.host.files import absolute_path
from dora_systemd.decisions.cell.launch import LaunchPlan
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.properties.assignments import parse_line, with_properties
from dora_systemd.decisions.properties.sandbox import LEVELS, NETWORKS, Sandbox, sandbox_properties
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.decisions.unit.properties import UnitContext, format_unit, unit_properties
from dora_systemd.decisions.unit.systemd_versions import MIN_VERSION, drop_unsupported
from dora_systemd.decisions.why.remedies import known_remedy
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.sight import Sight
from dora_systemd.verbs.start.sandbox import _maps_identity, make_sandbox, sandbox_warnings
from dora_systemd.verbs.start.where import Look
from tests.unit.fakes.manager import options

places = st.sampled_from(
    [
        "/",
        "/srv/x",
        "/tmp",
        "/tmp/x",
        "/var/tmp/x/y",
        "/home/x",
        "/home/x/p",
        "/root",
        "/tmp/a:b",
        "/home/x/p q",
    ]
)
sandboxes = st.builds(
    Sandbox,
    level=st.sampled_from(LEVELS),
    network=st.sampled_from(NETWORKS),
    is_user=st.booleans(),
    is_root=st.booleans(),
    has_devices=st.booleans(),
    has_can=st.booleans(),
    is_realtime=st.booleans(),
    has_identity=st.booleans(),
    needed=st.lists(places).map(tuple),
    writable=st.lists(places).map(tuple),
    firm=st.dictionaries(places, st.sampled_from(["/", "/tmp", "/home", "/home/x", "/srv"])),
    directory=st.sampled_from(["", "/run/dora-systemd/robot"]),
).filter(lambda one: all(Path(path).is_relative_to(firm) for path, firm in one.firm.items()))
DEFAULT = sandbox_properties(Sandbox())
STRICT = sandbox_properties(Sandbox(level="strict"))


def value(sandbox: Sandbox, slot: str) -> object:
    """What the property is, None if it is not set."""
    found = sandbox_properties(sandbox).get(slot)
    return found and found.value


def test_levels_only_add() -> None:
    assert sandbox_properties(Sandbox(level="none")) == {}
    assert DEFAULT.keys() < STRICT.keys()
    changed = {slot for slot, one in DEFAULT.items() if STRICT[slot] != one}
    assert changed == {"ProtectHome", "PrivateUsers"}


def test_a_can_bus_opens_its_socket_family() -> None:
    others = ("AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK")
    assert value(Sandbox(), "RestrictAddressFamilies") == (True, others)
    for is_user in (False, True):
        found = value(Sandbox(has_can=True, is_user=is_user), "RestrictAddressFamilies")
        assert found == (True, (*others, "AF_CAN"))
    assert sandbox_properties(Sandbox(level="none", has_can=True)) == {}


@given(sandboxes)
def test_every_property_is_declared_and_old(sandbox: Sandbox) -> None:
    properties = sandbox_properties(sandbox)
    for slot, one in properties.items():
        kinds = dict(TABLE[slot.removesuffix("~")].choices)
        assert kinds[one.name].signature == one.signature
    kept, warnings = drop_unsupported(properties, MIN_VERSION)
    left_out = {slot for slot, one in properties.items() if one.value == "identity"}
    assert properties.keys() - kept.keys() == left_out
    assert not warnings


@given(sandboxes)
def test_unit_text_says_the_same(sandbox: Sandbox) -> None:
    properties = sandbox_properties(sandbox)
    again: dict[str, object] = {}
    for line in format_unit(properties).splitlines():
        if line and not line.startswith("["):
            key, _, text = line.partition("=")
            again = with_properties(again, parse_line(key, text.replace("%%", "%")))  # type: ignore
    assert again == properties


@given(sandboxes)
def test_nothing_and_its_contrary(sandbox: Sandbox) -> None:
    properties = sandbox_properties(sandbox)
    assert not {"PrivateDevices", "DevicePolicy"} <= properties.keys()
    assert not {"PrivateNetwork", "IPAddressDeny"} <= properties.keys()
    assert not (sandbox.is_root and "PrivateUsers" in properties)
    assert not (sandbox.is_realtime and "RestrictRealtime" in properties)
    bound = {one[0] for one in (value(sandbox, "BindPaths") or ())}  # type: ignore
    read = {one[0] for one in (value(sandbox, "BindReadOnlyPaths") or ())}  # type: ignore
    assert not bound & read
    assert not bound & {*(value(sandbox, "ReadWritePaths") or ())}  # type: ignore


@given(sandboxes)
def test_everything_needed_is_visible_and_everything_writable_is_written(sandbox: Sandbox) -> None:
    properties = sandbox_properties(sandbox)
    if sandbox.level == "none" or sandbox.is_user:
        assert not {"ReadWritePaths", "BindPaths", "PrivateTmp", "ProtectHome"} & properties.keys()
        return
    hidden = ["/tmp", "/var/tmp"] if value(sandbox, "PrivateTmp") else []
    hidden += ["/home", "/root", "/run/user"] if value(sandbox, "ProtectHome") == "tmpfs" else []
    bound = [one[0] for one in (value(sandbox, "BindPaths") or ())]  # type: ignore
    read = [one[0] for one in (value(sandbox, "BindReadOnlyPaths") or ())]  # type: ignore
    written = value(sandbox, "ReadWritePaths") or ()
    for path in sandbox.needed:
        if any(Path(path).is_relative_to(place) for place in hidden):
            assert any(Path(path).is_relative_to(place) for place in (*bound, *read)), path
    for path in sandbox.writable:
        is_bound = any(Path(path).is_relative_to(place) for place in bound)
        assert is_bound or sandbox.firm.get(path, path) in written  # type: ignore


@given(sandboxes)
def test_nothing_is_mounted_that_somebody_could_replace(sandbox: Sandbox) -> None:
    properties = sandbox_properties(sandbox)
    given = {*sandbox.needed, *sandbox.writable}
    firm = {sandbox.firm.get(path, path) for path in given} | {
        sandbox.directory,
        "/tmp",
        "/var/tmp",
    }
    for key in ("BindPaths", "BindReadOnlyPaths"):
        assert {one[0] for one in (value(sandbox, key) or ())} <= firm  # type: ignore
    assert {*(value(sandbox, "ReadWritePaths") or ())} <= firm  # type: ignore
    assert bool(sandbox.directory and sandbox.has_mounts) == ("TemporaryFileSystem" in properties)


@given(sandboxes)
def test_the_owner_of_the_unit_has_the_last_word(sandbox: Sandbox) -> None:
    settings = resolve_settings({"property": ("ProtectSystem=no", "NoNewPrivileges=no")}, {}, [])
    context = UnitContext("/usr/bin/python3", sandbox.is_user, sandbox=sandbox)
    properties = unit_properties(options(), context, settings)
    assert properties["ProtectSystem"].value == "no"
    assert properties["NoNewPrivileges"].value is False


def test_a_project_below_tmp_is_mounted() -> None:
    sandbox = Sandbox(needed=("/tmp/p", "/tmp/p/.venv", "/srv"), writable=("/tmp/p/out", "/srv/o"))
    assert value(sandbox, "PrivateTmp") is True
    assert [one[0] for one in value(sandbox, "BindReadOnlyPaths")] == ["/tmp/p"]  # type: ignore
    assert [one[0] for one in value(sandbox, "BindPaths")] == ["/tmp/p/out"]  # type: ignore
    assert value(sandbox, "ReadWritePaths") == ("/srv/o",)


@pytest.mark.parametrize("odd", ["a:b", "a b", "a\tb", "a\nb", 'a"b', "a'b", "a\\b"])
def test_what_no_mount_can_be_called_keeps_its_place_open(odd: str) -> None:
    """systemd 257 writes mounts of a transient unit unquoted: a reload would read others."""
    below_tmp = Sandbox(needed=(f"/var/tmp/{odd}", "/srv"))
    assert value(below_tmp, "PrivateTmp") is False
    assert value(below_tmp, "BindReadOnlyPaths") is None
    (warning,) = sandbox_warnings(below_tmp)
    assert "cannot hide what is around" in warning
    for path in (f"/srv/{odd}", f"/home/x/{odd}"):
        assert value(Sandbox(needed=(path,)), "PrivateTmp") is True
        assert not list(sandbox_warnings(Sandbox(needed=(path,))))
    strict = Sandbox(level="strict", needed=(f"/home/x/{odd}",))
    assert value(strict, "ProtectHome") == "read-only"
    assert len(list(sandbox_warnings(strict))) == 1


def test_what_its_user_can_replace() -> None:
    hers = {"/tmp/p": "/tmp", "/home/x/p": "/home/x", "/home/x/p/out": "/home/x"}
    below_tmp = Sandbox(needed=("/tmp/p", "/srv"), firm=hers)
    assert value(below_tmp, "PrivateTmp") is False
    assert value(below_tmp, "BindReadOnlyPaths") is None
    assert list(sandbox_warnings(below_tmp)) == [
        "the sandbox cannot hide /tmp: users other than root can replace /tmp/p"
    ]
    at_home = Sandbox(level="strict", needed=("/home/x/p",), firm=hers)
    assert [one[0] for one in value(at_home, "BindReadOnlyPaths")] == ["/home/x"]  # type: ignore
    assert not list(sandbox_warnings(at_home))
    for level, key in (("strict", "BindPaths"), ("default", "ReadWritePaths")):
        written = Sandbox(level=level, writable=("/home/x/p/out",), firm=hers)
        assert "/home/x" in str(value(written, key))
        assert "/home/x/p" not in format_unit(sandbox_properties(written))
        assert list(sandbox_warnings(written)) == [
            "the nodes may write all of /home/x: its user could replace /home/x/p/out"
        ]
    assert not list(sandbox_warnings(Sandbox(level="none", writable=("/tmp/p",), firm=hers)))


def test_no_other_cell_is_seen() -> None:
    sandbox = Sandbox(directory="/run/dora-systemd/robot", writable=("/tmp/p",))
    text = format_unit(sandbox_properties(sandbox))
    assert "TemporaryFileSystem=/run/dora-systemd:ro\n" in text
    assert [one[0] for one in value(sandbox, "BindPaths")] == [  # type: ignore
        "/tmp/p",
        "/run/dora-systemd/robot",
    ]


def test_tmp_itself_is_shared_when_asked_for() -> None:
    sandbox = Sandbox(writable=("/tmp",))
    assert value(sandbox, "PrivateTmp") is False
    assert value(sandbox, "ReadWritePaths") == ("/tmp", "/var/tmp")


def test_devices() -> None:
    assert value(Sandbox(), "PrivateDevices") is True
    assert value(Sandbox(has_devices=True), "PrivateDevices") is None
    assert value(Sandbox(has_devices=True), "DevicePolicy") == "closed"


def test_root_reads_what_is_not_his() -> None:
    assert value(Sandbox(), "CapabilityBoundingSet") == 0
    assert value(Sandbox(is_root=True), "CapabilityBoundingSet") == 1 << 1 | 1 << 2


def test_a_user_cannot_mount() -> None:
    hers = sandbox_properties(Sandbox(level="strict", network="loopback", is_user=True))
    assert "SystemCallFilter" in hers
    assert not [one for one in hers if one.startswith(("Protect", "Private", "Capab", "IPAddr"))]


@pytest.mark.parametrize(
    ("level", "network", "words"),
    [
        ("strict", "host", ["protects no files"]),
        ("default", "loopback", ["loopback"]),
        ("default", "private", ["namespaces"]),
        ("default", "host", []),
    ],
)
def test_warnings(level: str, network: str, words: list[str]) -> None:
    found = list(sandbox_warnings(Sandbox(level=level, network=network, is_user=True)))
    assert len(found) == len(words)
    assert all(word in one for word, one in zip(words, found, strict=True))
    assert not list(sandbox_warnings(Sandbox(level=level, network=network)))


@pytest.mark.parametrize(
    ("flags", "message", "hint"),
    [
        ({"sandbox": "strikt"}, "cannot use 'strikt' as sandbox", "did you mean strict?"),
        ({"sandbox": "xyz"}, "cannot use 'xyz' as sandbox", "valid values: none, default, strict"),
        (
            {"network": "lan"},
            "cannot use 'lan' as network",
            "valid values: host, loopback, private",
        ),
    ],
)
def test_unknown_words(flags: dict[str, str], message: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError, match=message) as caught:
        resolve_settings(flags, {}, [])
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.hint == hint


SYSTEM = Scope(is_user=False, uid=os.getuid())
ME = pwd.getpwuid(os.getuid())


def made(
    tmp_path: Path,
    nodes: str = "/opt/x/camera",
    user: pwd.struct_passwd = ME,
    sight: Sight | None = None,
    offers_identity: bool | None = None,
    **flags: object,
) -> Sandbox:
    own = options(
        dataflow=f"{tmp_path}/flow.yml", working_directory=str(tmp_path), uv=bool(flags.get("uv"))
    )
    document = {"nodes": [{"id": "a", "path": nodes, "outputs": ["x"]}]}
    plan = LaunchPlan(own, "/l.sh", "/nowhere", os.path.exists, Sight().read)
    dataflow = parse_dataflow(document, "flow.yml")
    look = Look(sight or Sight(), resolve_settings(flags, {}, []), user, str(tmp_path))
    return make_sandbox(SYSTEM, look, dataflow, plan, offers_identity)


def test_what_a_plan_needs(tmp_path: Path) -> None:
    (tmp_path / "node").touch()
    sandbox = made(tmp_path, f"{tmp_path}/node")
    assert str(tmp_path) in sandbox.needed
    assert all(Path(one).exists() for one in sandbox.needed)
    assert len(set(sandbox.needed)) == len(sandbox.needed)
    assert (sandbox.level, sandbox.network, sandbox.writable) == ("default", "host", ())
    assert str(tmp_path) in made(tmp_path, uv=True).writable


class NotMine(Sight):
    """The sight of a user who may write nothing below /srv."""

    def exists(self, path: str) -> bool:
        return path != "/srv/new"

    def is_writable(self, path: str) -> bool:
        return not path.startswith("/srv")


def test_what_the_user_of_the_nodes_cannot_write(tmp_path: Path) -> None:
    robot = pwd.struct_passwd(("robot", "x", 990, 990, "", "/", "/bin/sh"))
    given = ("/srv/a b", str(tmp_path))
    sandbox = made(tmp_path, user=robot, sight=NotMine(), writable=given)
    words = "the nodes run as robot, who cannot write /srv/a b: chown robot '/srv/a b'"
    assert words in list(sandbox_warnings(sandbox))
    assert "cannot write" not in str(list(sandbox_warnings(made(tmp_path, writable=given[1:]))))
    with pytest.raises(DoraSystemdError) as caught:
        made(tmp_path, user=robot, sight=NotMine(), writable=("/srv/new",))
    assert str(caught.value.hint).startswith("install -d -o robot /srv/new,")


def test_a_workspace_of_uv(tmp_path: Path) -> None:
    """uv writes beside the pyproject.toml of the workspace."""
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot/pyproject.toml").touch()
    (tmp_path / "pyproject.toml").write_text('[tool.uv.workspace]\nmembers = ["robot"]\n')
    assert str(tmp_path) in made(tmp_path / "robot", uv=True).writable


def test_choices_of_a_plan(tmp_path: Path) -> None:
    assert made(tmp_path, device=("/dev/null",)).has_devices
    assert made(tmp_path, property=("DeviceAllow=/dev/null",)).has_devices
    assert made(tmp_path, realtime="20").is_realtime
    assert made(tmp_path).is_root == (os.getuid() == 0)


@pytest.mark.parametrize(
    ("uid", "gid", "has_identity"),
    [(990, 990, True), (65535, 65535, True), (65536, 990, False), (990, 200_000, False)],
)
def test_users_of_a_directory_service(
    tmp_path: Path, uid: int, gid: int, has_identity: bool
) -> None:
    """Their ids are not in the namespace."""
    user = pwd.struct_passwd(("robot", "x", uid, gid, "", "/", "/bin/sh"))
    assert made(tmp_path, user=user, offers_identity=True).has_identity == has_identity


@pytest.mark.parametrize("key", ["AmbientCapabilities", "CapabilityBoundingSet"])
def test_capabilities_that_are_given_count(tmp_path: Path, key: str) -> None:
    user = pwd.struct_passwd(("robot", "x", 990, 990, "", "/", "/bin/sh"))
    given = (f"{key}=CAP_NET_RAW",)
    assert not made(tmp_path, user=user, offers_identity=True, property=given).has_identity


@pytest.mark.parametrize(
    ("rows", "expected"),
    [("0 0 4294967295", True), ("0 100000 65536", True), ("0 1000 1\n1 100000 65536", False)],
)
def test_ids_of_a_container(tmp_path: Path, rows: str, expected: bool) -> None:
    (tmp_path / "uid_map").write_text(f"{rows}\n")
    assert _maps_identity(tmp_path / "uid_map") == expected


def test_writable_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")
    assert made(tmp_path, writable=("..", ".")).writable == (str(tmp_path), f"{tmp_path}/a")
    with pytest.raises(DoraSystemdError, match="there is no such file") as caught:
        made(tmp_path, writable=("none",))
    make = f"install -d -o {ME.pw_name} {tmp_path}/a/none"
    assert caught.value.hint == f"{make}, or correct --writable"
    assert caught.value.code is ExitCode.BAD_INPUT


def test_absolute_paths(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("/usr/lib")
    assert absolute_path("//usr//bin/") == "/usr/bin"
    assert absolute_path(f"{tmp_path}/link") == f"{tmp_path}/link"
    assert absolute_path(f"{tmp_path}/link/../bin") == "/usr/bin"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("OSError: [Errno 30] Read-only file system: '/srv/x'", "--writable PATH"),
        (
            'Os { code: 30, kind: ReadOnlyFilesystem, message: "Read-only file system" }',
            "--property StateDirectory=NAME",
        ),
        ("FileNotFoundError: [Errno 2] No such file or directory: '/dev/video0'", "--device"),
        ("FileNotFoundError: [Errno 2] No such file or directory: '/tmp/map'", "--writable /tmp"),
        ("python: can't open file '/srv/x.py': [Errno 2] No such file", "only a restart of the"),
        ("python: can't open file '/srv/x.py': [Errno 13] Permission denied", ""),
        ("PermissionError: [Errno 1] Operation not permitted", "--sandbox none"),
        ("OSError: [Errno 97] Address family not supported by protocol", "--sandbox none"),
        ("FileNotFoundError: [Errno 2] No such file or directory: 'model.pt'", ""),
        ("ModuleNotFoundError: No module named 'dora'", "pip install dora-rs"),
        ("ModuleNotFoundError: No module named 'dora_extra'", ""),
        ("OSError: [Errno 28] No space left on device", "that the node writes to"),
        ("OSError: [Errno 28] No space left on device: '/a/{b}'", "df '/a/{b}'"),
        ("", ""),
        ("error: Failed to initialize cache at `/.cache/uv`", "--property CacheDirectory=NAME"),
        ("[ WARN:0] VIDEOIO(V4L2:/dev/video0): can't open camera by index", "--device PATH"),
        ("qt.qpa.xcb: could not connect to display :0", "BindReadOnlyPaths=/tmp/.X11-unix"),
        ("_tkinter.TclError: no display name and no $DISPLAY environment variable", "DISPLAY=:0"),
        ("gtk: Cannot open display: ", "--env DISPLAY=:0"),
        ("RuntimeError: can't start new thread", "--tasks-limit N"),
        ("/bin/bash: fork: retry: Resource temporarily unavailable", "NODE:tasks_limit=N"),
    ],
)
def test_signs_of_the_sandbox(line: str, words: str) -> None:
    found = known_remedy(["Traceback (most recent call last):", line])
    assert (words in found) if words else found == ""
