"""Settings: where each value comes from, what is refused, and that one line adds one."""

from collections.abc import Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.cell.black_box import BlackBox
from dora_systemd.decisions.cell.line_rates import RateLimit
from dora_systemd.decisions.cell.owes import Owed
from dora_systemd.decisions.cell.stops import NodeStop
from dora_systemd.decisions.properties.sandbox import LEVELS, NETWORKS
from dora_systemd.decisions.recorder.record import Record
from dora_systemd.decisions.settings.kinds import DURATION, PATHS, TEXT, Setting
from dora_systemd.decisions.settings.machines import Declared
from dora_systemd.decisions.settings.nodes import nodes_setting
from dora_systemd.decisions.settings.reload import REPLACE_WORDS
from dora_systemd.decisions.settings.resolve import (
    DEFAULT_SOURCE,
    Settings,
    check_document,
    resolve_settings,
)
from dora_systemd.decisions.settings.table import (
    ALLOW_SHELL_NODES,
    DORA,
    ENV,
    ENV_FILE,
    EXIT_WHEN_NODES_FINISH,
    GRACE_DURATION,
    NODES,
    PROPERTY,
    SETTINGS,
    USER,
    UV,
    VENV,
    WORKING_DIRECTORY,
)
from dora_systemd.decisions.watchdog.watchdogs import SHORTEST
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND
from tests.unit.fakes.limit_values import IDS, LIMIT_VALUES, RESTART_VALUES
from tests.unit.fakes.rights_values import RIGHTS_VALUES

BESIDE = "/srv/robot.systemd.yml"
HOME = "/home/me/.config/dora-systemd/config.yml"
SYSTEM = "/etc/dora-systemd/config.yml"


def resolved(
    flags: Mapping[str, object] | None = None,
    variables: Mapping[str, str] | None = None,
    *documents: object,
) -> Settings:
    files = list(zip((BESIDE, HOME, SYSTEM), documents, strict=False))
    return resolve_settings(flags or {}, variables or {}, files)


def test_defaults() -> None:
    settings = resolved()
    assert settings[GRACE_DURATION] == 10 * SECOND
    assert settings[ENV] == {}
    assert settings[VENV] is None
    assert settings[DORA] == "dora"
    assert {settings.source(setting) for setting in SETTINGS} == {DEFAULT_SOURCE}


def test_precedence() -> None:
    """Flag, variable, file beside the dataflow, the user's, the system's, default."""
    flags = {"grace_duration": "1s"}
    variables = {"DORA_GRACE_DURATION": "2s"}
    documents = [{"grace_duration": f"{seconds}s"} for seconds in (3, 4, 5)]
    sources = ["--grace-duration", "DORA_GRACE_DURATION", BESIDE, HOME, SYSTEM, DEFAULT_SOURCE]
    steps: list[Any] = [
        (flags, variables, *documents),
        ({}, variables, *documents),
        ({}, {}, *documents),
        ({}, {}, None, *documents[1:]),
        ({}, {}, {}, {"grace_duration": None}, documents[2]),
        ({}, {}, None, None, None),
    ]
    for place, (step, source) in enumerate(zip(steps, sources, strict=True)):
        settings = resolved(*step)
        assert settings[GRACE_DURATION] == (place + 1 if place < 5 else 10) * SECOND
        assert settings.source(GRACE_DURATION) == source


def test_flags_that_were_not_given_count_as_nothing() -> None:
    flags = {"uv": None, "env": (), "grace_duration": None}
    settings = resolved(flags, {"DORA_UV": ""}, {"uv": True})
    assert settings[UV] is True
    assert settings.source(UV) == BESIDE


def test_a_flag_can_say_no() -> None:
    assert resolved({"uv": False}, {}, {"uv": True})[UV] is False


def test_env_merges_key_by_key() -> None:
    settings = resolved(
        {"env": ("A=flag", "E=x=y")},
        {},
        {"env": {"A": "beside", "B": "beside", "C": 1, "D": True}},
        None,
        {"env": ["B=system", "F=system"]},
    )
    assert settings[ENV] == {
        "A": "flag",
        "B": "beside",
        "C": "1",
        "D": "true",
        "E": "x=y",
        "F": "system",
    }
    assert settings.source(ENV) == f"--env, {BESIDE}, {SYSTEM}"


def test_lists_are_joined_the_most_important_last() -> None:
    document = {"property": {"Nice": 5, "NoNewPrivileges": True, "After": ["a", "b"]}}
    settings = resolved({"property": ("Nice=6",)}, {}, document, {"env_file": "x.env"})
    assert settings[PROPERTY] == (
        *("Nice=5", "NoNewPrivileges=yes", "After=a", "After=b"),
        "Nice=6",
    )
    assert settings[ENV_FILE] == ("/home/me/.config/dora-systemd/x.env",)


def test_paths_in_a_file_start_beside_it() -> None:
    document = {
        "venv": ".venv",
        "working_directory": "/abs",
        "env_file": ["a.env", "/b.env"],
        "dora": "bin/dora",
    }
    settings = resolved({}, {"DORA_PROGRAM": ""}, document)
    assert settings[VENV] == "/srv/.venv"
    assert settings[WORKING_DIRECTORY] == "/abs"
    assert settings[ENV_FILE] == ("/srv/a.env", "/b.env")
    assert settings[DORA] == "/srv/bin/dora"
    assert resolved({}, {}, {"dora": "dora-nightly"})[DORA] == "dora-nightly"
    assert resolved({"venv": ".venv"})[VENV] == ".venv"


def test_words_of_yaml_1_1_are_booleans_too() -> None:
    settings = resolved({}, {}, {"uv": "yes", "allow_shell_nodes": "off"})
    assert settings[UV] is True
    assert settings[ALLOW_SHELL_NODES] is False
    assert resolved({}, {"DORA_EXIT_WHEN_NODES_FINISH": "no"})[EXIT_WHEN_NODES_FINISH] is False


def test_a_numeric_user_is_a_text() -> None:
    assert resolved({}, {}, {"user": 1000})[USER] == "1000"


@pytest.mark.parametrize(
    ("document", "message", "hint"),
    [
        ([], "it is not a mapping", "mapping"),
        ("text", "it is not a mapping", "mapping"),
        ({"grace_duratoin": 1}, "unknown key 'grace_duratoin'", "did you mean grace_duration?"),
        ({"grace-duration": 1}, "unknown key 'grace-duration'", "did you mean grace_duration?"),
        ({"essential": True}, "unknown key 'essential'", "write essential below nodes:"),
        (
            {"nodes": {"a": {"uv": True}}},
            "unknown key 'uv' of node 'a'",
            "write uv outside of nodes:",
        ),
        ({"zzzzzz": 1}, "unknown key 'zzzzzz'", "dora-systemd.yml(5)"),
        ({1: 2}, "a key in it is int, not text", "quotes"),
        ({"uv": [1]}, "the value of uv is of another type", "yes or no"),
        ({"uv": 1}, "the value of uv is of another type", "yes or no"),
        ({"env": "A=1"}, "the value of env is of another type", "KEY: VALUE"),
        ({"env": {"A": [1]}}, "the value of env.A is of another type", "in quotes"),
        ({"env": {"B": "1", "A": None}}, "the value of env.A is of another type", "in quotes"),
        ({"property": {"Nice": None}}, "the value of property.Nice is of another type", "quotes"),
        ({"env": {"\b": None}}, r"the value of env.'\x08' is of another type", "in quotes"),
        ({"venv": {"a": 1}}, "the value of venv is of another type", "a path"),
        ({"property": 5}, "the value of property is of another type", "PROPERTY: VALUE"),
    ],
)
def test_bad_files(document: object, message: str, hint: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        resolved({}, {}, document)
    assert caught.value.message == f"cannot use {BESIDE}: {message}"
    assert hint in caught.value.hint
    assert caught.value.code == ExitCode.BAD_INPUT


def test_bad_values_name_their_source() -> None:
    with pytest.raises(DoraSystemdError) as caught:
        resolved({}, {}, {"grace_duration": "5 parsec"})
    assert (
        caught.value.message == f"cannot read '5 parsec' as a duration (grace_duration in {BESIDE})"
    )
    assert caught.value.code == ExitCode.BAD_INPUT
    with pytest.raises(DoraSystemdError, match=r"\(--grace-duration\)$") as caught:
        resolved({"grace_duration": "-1"})
    assert caught.value.code == ExitCode.USAGE
    with pytest.raises(DoraSystemdError, match=r"\(DORA_UV\)$"):
        resolved({}, {"DORA_UV": "maybe"})
    with pytest.raises(DoraSystemdError, match=r"\(--env\)$"):
        resolved({"env": ("A",)})


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
keys = st.sampled_from([setting.name for setting in SETTINGS]) | st.text()


@given(st.dictionaries(keys, json_values) | json_values)
def test_any_document_is_used_or_refused(document: object) -> None:
    try:
        resolved({}, {}, document)
    except DoraSystemdError as error:
        assert error.message.startswith("cannot")
        assert error.message.isprintable()


@given(st.data())
def test_values_and_back(data: st.DataObject) -> None:
    """What a kind formats it parses again: for `show`, and for units that are written."""
    texts = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1)
    examples: dict[str, st.SearchStrategy[Any]] = {
        "env": st.dictionaries(st.from_regex(r"X_[A-Z]{1,5}", fullmatch=True), texts),
        "env_file": st.lists(texts).map(tuple),
        "property": st.lists(texts).map(tuple),
        "grace_duration": st.integers(0, 2**64 - 1),
        "stop_limit": st.integers(0, 2**60),
        "stop": st.builds(NodeStop, st.just(""), st.integers(1, 2**60), st.just(("arm", "cam"))),
        "on_failure": st.just(("/bin/x", "a b", "$c")) | st.just(("unit:tell@.service",)),
        "black_box": st.sampled_from([None, BlackBox(), BlackBox(2, 8 << 20)]),
        "record": st.sampled_from([None, Record(), Record(SECOND, 1 << 20, ("cam/image",))]),
        "owes": st.just((Owed("", "image", 2 * SECOND),)) | st.just(()),
        "log_rate_limit": st.none() | st.just(RateLimit(5, SECOND)),
        "watchdog": st.just(INFINITY) | st.integers(SHORTEST, 2**60),
        "sandbox": st.sampled_from(LEVELS),
        "network": st.sampled_from(NETWORKS),
        "writable": st.lists(texts).map(tuple),
        "credentials": st.dictionaries(
            st.from_regex(r"[a-z.]{3,9}", fullmatch=True), texts.filter(lambda x: x[-1] != "\\")
        ),
        "machines": st.dictionaries(
            st.sampled_from(["gpu", "npu"]), texts.map(lambda x: Declared({"host": x}, (None,)))
        ),
        **LIMIT_VALUES,
        **RESTART_VALUES,
        **RIGHTS_VALUES,
        "needs": st.sampled_from([("network",), ("mount:/mnt/x", "clock")]),
        "watch": st.just(("*.py", "config/*")),
        "ignore": st.just(("draft_*",)),
        "replace": st.sampled_from(REPLACE_WORDS),
    }
    of_nodes = {one.name for one in SETTINGS if one.per_node} & examples.keys() - {"needs"}
    values = st.fixed_dictionaries({}, optional={name: examples[name] for name in of_nodes})
    values = values.map(lambda found: {key: value for key, value in found.items() if value != ()})
    examples["nodes"] = st.dictionaries(IDS, values.filter(bool), max_size=2)
    for setting in SETTINGS:
        strategy = st.booleans() if setting.kind.is_flag else examples.get(setting.name, texts)
        value = data.draw(strategy, label=setting.name)
        formatted = list(setting.kind.format(value))
        text = tuple(formatted) if setting.kind.is_repeatable else formatted[0]
        assert setting.kind.parse(text, None) == value


def test_every_setting_can_be_set_everywhere() -> None:
    for setting in SETTINGS:
        assert setting.help.endswith(".")
        if setting.only_nodes:
            assert setting.per_node
            assert not setting.flags
            assert not setting.variable
            continue
        assert setting.flags[0].startswith("--")
        assert setting.variable.startswith("DORA_") or setting.kind.is_repeatable
        assert setting.metavar or setting.kind.is_flag
    names = [setting.name for setting in SETTINGS]
    assert len(set(names)) == len(names)


def test_flag_and_variable_follow_from_the_name() -> None:
    one = Setting[int]("pace_limit", DURATION, 5, "A pace.")
    assert (one.flags, one.variable) == (("--pace-limit",), "DORA_PACE_LIMIT")
    many = Setting[tuple[str, ...]]("pace", PATHS, (), "Paces.")
    assert (many.flags, many.variable) == (("--pace",), ""), "a variable has one value"


MODE = Setting[str](
    "mode", TEXT, "", "A mode.", ("--mode",), "DORA_MODE", "MODE", per_node=True, property="X"
)
PACE = Setting[int]("pace", DURATION, 5, "A pace.", ("--pace",), "DORA_PACE", "TIME", per_node=True)


def test_a_new_setting_is_one_declaration() -> None:
    own = (*(one for one in SETTINGS if one is not NODES), MODE, PACE)
    table = (*own, nodes_setting(own))
    document = {"mode": "a", "nodes": {"camera": {"mode": "b", "pace": "1s"}, "detector": None}}
    user = {"nodes": {"camera": {"mode": "c", "pace": "2s"}, "other": {"pace": 3}}}
    settings = resolve_settings({}, {}, [(BESIDE, document), (HOME, user)], table)
    assert settings[MODE] == "a"
    assert settings.nodes == {
        "camera": {"mode": "b", "pace": SECOND},
        "other": {"pace": 3 * SECOND},
    }


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"nodes": {"camera": {"uv": True}}}, "unknown key 'uv' of node 'camera'"),
        ({"nodes": {"camera": {"mod": 1}}}, "unknown key 'mod' of node 'camera'"),
        ({"nodes": {"camera": 5}}, "the value of nodes is of another type"),
        ({"nodes": []}, "the value of nodes is of another type"),
        ({"nodes": {"camera": []}}, "the value of nodes is of another type"),
        ({"nodes": {"camera": ""}}, "the value of nodes is of another type"),
    ],
)
def test_bad_settings_of_nodes(document: object, message: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        check_document(BESIDE, document, (*SETTINGS, MODE, PACE))
    assert caught.value.message == f"cannot use {BESIDE}: {message}"


def test_nodes_need_settings_per_node() -> None:
    table = [setting for setting in SETTINGS if not setting.per_node]
    with pytest.raises(DoraSystemdError, match="unknown key 'nodes'"):
        check_document(BESIDE, {"nodes": {}}, [UV])
        check_document(BESIDE, {"nodes": {}}, table)
