"""Every property: text to D-Bus, to the text of a unit file, and to D-Bus again."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.properties.assignments import (
    Newer,
    format_property,
    parse_property,
    unknown_keys,
    with_properties,
)
from dora_systemd.decisions.properties.kinds import (
    SCALE,
    Property,
    escape_specifiers,
    quote_word,
    split_words,
)
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY
from tests.unit.fakes.property_samples import sample, settable_keys


def one(assignment: str) -> tuple[str, str, Any]:
    (name, signature, value) = next(iter(parse_property(assignment).values()))
    return name, signature, value


def read_again(properties: dict[str, Property]) -> dict[str, Property]:
    """What the text of `properties` in a unit file says."""
    result: dict[str, Property] = {}
    for slot in properties:
        for line in format_property(slot, properties):
            assert not any(char < " " for char in line)
            result = with_properties(result, parse_property(line.replace("%%", "%")))
    return result


def test_text_and_back() -> None:
    for key in settable_keys():
        properties = parse_property(sample(key))
        assert read_again(properties) == properties


def test_values_are_of_their_types() -> None:
    for key in settable_keys():
        for _, signature, value in parse_property(sample(key)).values():
            check_type(signature, value)


def check_type(signature: str, value: Any) -> None:
    basic = {"s": str, "b": bool, "i": int, "u": int, "t": int, "y": int}
    if signature in basic:
        assert type(value) is basic[signature]
    elif signature.startswith("a"):
        for item in value:
            check_type(signature[1:], item)
    else:
        parts = [*signature[1:-1].replace("as", "S").replace("ai", "I").replace("ay", "Y")]
        for part, item in zip(parts, value, strict=True):
            check_type({"S": "as", "I": "ai", "Y": "ay"}.get(part, part), item)


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("MemoryMax=4G", ("MemoryMax", "t", 4 * 1024**3)),
        ("MemoryMax=50%", ("MemoryMaxScale", "u", (SCALE + 1) // 2)),
        ("MemoryMax=infinity", ("MemoryMax", "t", INFINITY)),
        ("MemoryMax=", ("MemoryMax", "t", INFINITY)),
        ("TasksMax=infinity", ("TasksMax", "t", INFINITY)),
        ("TasksMax=10%", ("TasksMaxScale", "u", (SCALE + 5) // 10)),
        ("CPUQuota=150%", ("CPUQuotaPerSecUSec", "t", 1_500_000)),
        ("CPUQuota=", ("CPUQuotaPerSecUSec", "t", INFINITY)),
        ("CPUWeight=idle", ("CPUWeight", "t", 0)),
        ("TimerSlackNSec=50us", ("TimerSlackNSec", "t", 50_000)),
        ("TimerSlackNSec=infinity", ("TimerSlackNSec", "t", INFINITY)),
        ("TimeoutStopSec=1min", ("TimeoutStopUSec", "t", 60_000_000)),
        ("Restart=on-failure", ("Restart", "s", "on-failure")),
        ("ProtectHome=true", ("ProtectHome", "s", "yes")),
        ("UMask=022", ("UMask", "u", 0o22)),
        ("WatchdogSignal=TERM", ("WatchdogSignal", "i", 15)),
        ("EnvironmentFile=-/a", ("EnvironmentFiles", "a(sb)", (("/a", True),))),
        ("EnvironmentFile=", ("EnvironmentFiles", "a(sb)", ())),
        ("DeviceAllow=/dev/a rw", ("DeviceAllow", "a(ss)", (("/dev/a", "rw"),))),
        ("DeviceAllow=char-video", ("DeviceAllow", "a(ss)", (("char-video", ""),))),
        ("IOReadBandwidthMax=/dev/a 5M", ("IOReadBandwidthMax", "a(st)", (("/dev/a", 5000000),))),
        ("BindPaths=/a", ("BindPaths", "a(ssbt)", (("/a", "/a", False, 1 << 14),))),
        ("BindPaths=-/a:/b:norbind", ("BindPaths", "a(ssbt)", (("/a", "/b", True, 0),))),
        ("LoadCredential=a", ("LoadCredential", "a(ss)", (("a", "a"),))),
        ("IPAddressAllow=10.1.2.3/8", ("IPAddressAllow", "a(iayu)", ((2, b"\n\0\0\0", 8),))),
        ("SystemCallFilter=~@a @b", ("SystemCallFilter", "(bas)", (False, ("@a", "@b")))),
        ("CPUAffinity=0-2 8", ("CPUAffinity", "ay", b"\x07\x01")),
        ("CPUAffinity=numa", ("CPUAffinityFromNUMA", "b", True)),
        ("PrivateTmp=yes", ("PrivateTmp", "b", True)),
        ("PrivateTmp=disconnected", ("PrivateTmpEx", "s", "disconnected")),
        ("StandardOutput=file:/a", ("StandardOutputFile", "s", "/a")),
        ("RestrictNamespaces=yes", ("RestrictNamespaces", "t", 0)),
        ("CapabilityBoundingSet=", ("CapabilityBoundingSet", "t", 0)),
        ("SuccessExitStatus=2 SIGINT", ("SuccessExitStatus", "(aiai)", ((2,), (2,)))),
        (
            "ExecStopPost=-@/bin/a b $c",
            ("ExecStopPostEx", "a(sasas)", (("/bin/a", ("b", "$c"), ("ignore-failure",)),)),
        ),
        (
            "ConditionPathExists=|!/a",
            ("Conditions", "a(sbbs)", (("ConditionPathExists", True, True, "/a"),)),
        ),
    ],
)
def test_values(assignment: str, expected: tuple[str, str, Any]) -> None:
    assert one(assignment) == expected


NEWER = Newer(
    262,
    {
        "PrivateBPF": "b",
        "StateDirectoryQuota": "t",
        "NewUSec": "t",
        "Names": "as",
        "Count": "u",
        "Word": "s",
        "Pairs": "a(ss)",
    },
)


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("OOMPolicy=continue-on", ("OOMPolicy", "s", "continue-on")),
        ("OOMPolicy=stop", ("OOMPolicy", "s", "stop")),
        ("PrivateUsers=managed", ("PrivateUsersEx", "s", "managed")),
        ("PrivateBPF=yes", ("PrivateBPF", "b", True)),
        ("StateDirectoryQuota=5M", ("StateDirectoryQuota", "t", 5 * 2**20)),
        ("NewSec=5", ("NewUSec", "t", 5_000_000)),
        ("Names=a b", ("Names", "as", ("a", "b"))),
        ("Count=3", ("Count", "u", 3)),
        ("Word=x y", ("Word", "s", "x y")),
    ],
)
def test_what_a_newer_systemd_knows(assignment: str, expected: tuple[str, str, Any]) -> None:
    properties = parse_property(assignment, NEWER)
    assert list(properties.values()) == [expected]
    key, _, text = assignment.partition("=")
    texts = {"NewSec": "5s", "StateDirectoryQuota": "5M"}
    assert format_property(key, properties) == [f"{key}={texts.get(key, text)}"]


@pytest.mark.parametrize(
    ("assignment", "message", "hint"),
    [
        ("Foo=5", "services have no such property", "directives"),
        ("PrivateBPF=perhaps", "cannot set property PrivateBPF to 'perhaps'", "yes or no"),
        ("Pairs=a:b", "cannot set property Pairs from here", "drop-in"),
        ("Restart=on failure", "cannot set property Restart to 'on failure'", "on-failure"),
        ("Nice=much", "cannot set property Nice to 'much'", "between -20 and 19"),
        ("ExecStart=/bin/x", "needs it to supervise", "leave it out"),
    ],
)
def test_what_a_newer_systemd_is_not_asked(assignment: str, message: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_property(assignment, NEWER)
    assert message in caught.value.message
    assert hint in caught.value.hint


def test_unknown_keys() -> None:
    assert unknown_keys(["Nice=5", "PrivateBPF=yes", "Restart=never"]) == ["PrivateBPF", "Restart"]


def test_resource_limits_are_two_properties() -> None:
    properties = parse_property("LimitNOFILE=10:20")
    assert list(properties.values()) == [("LimitNOFILESoft", "t", 10), ("LimitNOFILE", "t", 20)]
    assert format_property("LimitNOFILE", properties) == ["LimitNOFILE=10:20"]
    assert format_property("LimitNOFILESoft", properties) == []
    both = parse_property("LimitCORE=infinity")
    assert format_property("LimitCORE", both) == ["LimitCORE=infinity"]


def test_timeout_sec_is_two_properties() -> None:
    assert list(parse_property("TimeoutSec=5")) == ["TimeoutStartSec", "TimeoutStopSec"]


@pytest.mark.parametrize(
    ("assignment", "message", "hint"),
    [
        ("", "cannot set property '': it has no value", "KEY=VALUE"),
        ("Nice", "cannot set property 'Nice': it has no value", "KEY=VALUE"),
        ("=5", "cannot set property '': services have no such property", "directives"),
        ("Foo=5", "cannot set property Foo: services have no such property", "directives"),
        ("MemoryMaxx=5", "services have no such property", "did you mean MemoryMax"),
        ("memorymax=5", "services have no such property", "did you mean MemoryMax?"),
        ("LimitCORESoft=5", "services have no such property", "LimitCORE"),
        ("MemoryMaxScale=5", "services have no such property", "MemoryMax"),
        ("Nice=100", "cannot set property Nice to '100'", "between -20 and 19"),
        ("StateDirectory=a dora-systemd/b", "cannot set property StateDirectory", "another name"),
        ("StateDirectory=a:dora-systemd", "cannot set property StateDirectory", "another name"),
        ("Restart=yes", "cannot set property Restart to 'yes'", "on-failure"),
        ("MemoryMax=4 gigs", "cannot set property MemoryMax to '4 gigs'", "512M"),
        ("MemoryMax=101%", "cannot set property MemoryMax to '101%'", "percentage"),
        ("LimitNICE=+5", "cannot set property LimitNICE to '+5'", "a number"),
        ("LoadCredential=:x", "cannot set property LoadCredential to ':x'", "ID:PATH"),
        ("LimitNOFILE=x", "cannot set property LimitNOFILE to 'x'", "a number"),
        ("ExecStopPost=true", "cannot set property ExecStopPost to 'true'", "absolute path"),
        ("Description=a\nExecStart=/x", "cannot set property Description to", "one line"),
        ("Description=a\\", "cannot set property Description to", "one line"),
        ("OpenFile=/x", "cannot set property OpenFile from here", "systemctl edit"),
        ("Type=simple", "cannot set property Type: ", "leave it out"),
        ("Delegate=no", "cannot set property Delegate: ", "leave it out"),
        ("ExecStart=/bin/x", "cannot set property ExecStart: ", "leave it out"),
        ("KillMode=process", "cannot set property KillMode: ", "leave it out"),
        ("RuntimeDirectory=x", "cannot set property RuntimeDirectory: ", "leave it out"),
        ("NotifyAccess=all", "cannot set property NotifyAccess: ", "leave it out"),
        ("WorkingDirectory=/x", "--working-directory", "leave it out"),
        ("SetCredential=a:b", "LoadCredential", "leave it out"),
    ],
)
def test_bad_properties(assignment: str, message: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_property(assignment)
    assert message in caught.value.message
    assert hint in caught.value.hint
    assert caught.value.code == ExitCode.USAGE


def test_a_bad_environment_is_not_shown() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_property("Environment=1A=hunter2")
    assert "hunter2" not in caught.value.message + caught.value.hint


def test_scalars_replace_and_lists_are_joined() -> None:
    properties: dict[str, Property] = {}
    for assignment in (
        *("Nice=1", "Nice=2", "MemoryMax=1G", "MemoryMax=50%"),
        *("After=a.service", "After=b.service", "Environment=A=1", "Environment=B=2"),
        *("SuccessExitStatus=1", "SuccessExitStatus=2 SIGINT", "CPUAffinity=0", "CPUAffinity=1"),
        *("SystemCallFilter=@a", "SystemCallFilter=~@b", "SystemCallFilter=@c"),
        *("ConditionHost=a", "ConditionHost=b", "DeviceAllow=/dev/a", "DeviceAllow="),
    ):
        properties = with_properties(properties, parse_property(assignment))
    lines = [line for slot in properties for line in format_property(slot, properties)]
    assert lines == [
        *("Nice=2", "MemoryMax=50%", "After=a.service b.service"),
        *("Environment=A=1", "Environment=B=2", "SuccessExitStatus=1 2 SIGINT", "CPUAffinity=1"),
        *("SystemCallFilter=@a @c", "SystemCallFilter=~@b"),
        *("ConditionHost=a", "ConditionHost=b", "DeviceAllow="),
    ]


def test_an_empty_filter_forgets_both_lists() -> None:
    properties: dict[str, Property] = {}
    for assignment in ("SystemCallFilter=@a", "SystemCallFilter=~@b", "SystemCallFilter="):
        properties = with_properties(properties, parse_property(assignment))
    assert properties == {"SystemCallFilter": ("SystemCallFilter", "(bas)", (True, ()))}


def test_what_unit_files_cannot_say_is_a_comment() -> None:
    properties = {"StandardInputFileDescriptor": Property("StandardInputFileDescriptor", "h", 0)}
    assert format_property("StandardInputFileDescriptor", properties) == [
        "# StandardInputFileDescriptor is set by doractl"
    ]


@pytest.mark.parametrize("text", ["''~", "~~lo", "~'~lo'"])
def test_a_filter_is_turned_round_once(text: str) -> None:
    with pytest.raises(DoraSystemdError, match="cannot set property RestrictNetworkInterfaces"):
        parse_property(f"RestrictNetworkInterfaces={text}")


plain = st.text(st.characters(exclude_categories=["Cs"]))


@given(st.sampled_from(settable_keys()), plain | st.text("0123456789.%KMGs:/-~ '\"\\=a"))
def test_any_value_is_read_and_said_again_or_refused(key: str, text: str) -> None:
    try:
        properties = parse_property(f"{key}={text}")
    except DoraSystemdError as error:
        assert error.message.startswith("cannot set property")
        assert error.message.isprintable()
        return
    if "%%" not in text:
        assert read_again(properties) == properties


@given(st.text() | st.sampled_from(sorted(TABLE)).map(lambda key: key.lower() + "=1"))
def test_any_assignment_is_read_or_refused(assignment: str) -> None:
    try:
        parse_property(assignment)
    except DoraSystemdError as error:
        assert error.message.isprintable()


words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", []),
        ("  a  b ", ["a", "b"]),
        ("'a b' \"c d\"e", ["a b", "c de"]),
        ("'' \"\"", ["", ""]),
        (r"a\nb \x41 \u00e4 \101 \s \\ \q", ["a\nb", "A", "ä", "A", " ", "\\", "q"]),
        ('"it\'s" \'say "x"\'', ["it's", 'say "x"']),
        ("a\tb\nc", ["a", "b", "c"]),
    ],
)
def test_words(text: str, expected: list[str]) -> None:
    assert split_words(text) == expected


@pytest.mark.parametrize("text", ["'a", '"', "a\\", r"\x00", r"\ud800", r"\U00110000"])
def test_unfinished_words(text: str) -> None:
    with pytest.raises(ValueError, match="a"):
        split_words(text)


@given(st.lists(words))
def test_quoted_and_split_again(given_words: list[str]) -> None:
    line = " ".join(quote_word(word) for word in given_words)
    assert line.isprintable() or not any(char < " " for char in line)
    assert split_words(line) == [escape_specifiers(word) for word in given_words]


@given(words)
def test_no_specifier_is_left(text: str) -> None:
    assert escape_specifiers(text).count("%") % 2 == 0


@given(st.text())
def test_any_text_is_split_or_refused(text: str) -> None:
    try:
        split_words(text)
    except ValueError as error:
        assert str(error)
