"""Restart policies: read, handed to dora and systemd, and what is left of them."""

from typing import Any

import pytest

from dora_systemd.decisions.cell.launch import idle_budgets, launch_descriptor
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import policies_of
from dora_systemd.decisions.cell.restarts import (
    DEFAULT,
    HEAD_START,
    Budget,
    RestartPolicy,
    budget_words,
    restart_of,
    unit_budget,
)
from dora_systemd.decisions.descriptor.dataflow import parse_dataflow
from dora_systemd.decisions.settings.resolve import (
    Settings,
    idle_warnings,
    require_effect,
    resolve_settings,
    with_settings,
)
from dora_systemd.decisions.unit.properties import restart_properties
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND
from tests.unit.decisions.cell.test_launch import plan
from tests.unit.fakes.manager import options, with_restart

MINUTE = 60 * SECOND
FILE = "/srv/robot.systemd.yml"
POLICY = RestartPolicy("on-failure", 3, 10 * MINUTE, SECOND, 8 * SECOND)


def settings(flags: dict[str, object], document: object = None) -> Settings:
    return resolve_settings(flags, {}, [(FILE, document)])


def runner(given: Settings) -> RunnerOptions:
    return with_settings(options(), given)


def test_from_settings() -> None:
    given = settings(
        {"restart_policy": "on-failure", "restart_delay": "40s"},
        {"max_restarts": 3, "nodes": {"camera": {"restart_policy": "always"}, "plot": None}},
    )
    expected = RestartPolicy("on-failure", 3, DEFAULT.window, 40 * SECOND, 40 * SECOND)
    assert restart_of(runner(given)) == expected
    assert policies_of(runner(given)) == {"camera": expected._replace(policy="always")}


OWES = {"output": "image", "within": "2s"}


@pytest.mark.parametrize(
    ("node", "policy"),
    [
        ({"max_restarts": 2}, "no"),
        ({"max_restarts": 2, "owes": OWES}, "on-failure"),
        ({"max_restarts": 2, "owes": {**OWES, "then": "warn"}}, "no"),
        ({"max_restarts": 2, "owes": OWES, "restart_policy": "no"}, "no"),
        ({"max_restarts": 2, "owes": OWES, "restart_policy": "always"}, "always"),
    ],
)
def test_a_budget_without_a_policy(node: dict[str, object], policy: str) -> None:
    given = settings({}, {"nodes": {"camera": node}})
    assert policies_of(runner(given)) == {"camera": DEFAULT._replace(policy=policy, max_restarts=2)}


def test_a_budget_of_what_a_node_owes_has_an_effect() -> None:
    document = {"max_restarts": 3, "nodes": {"camera": {"owes": OWES}}}
    assert not list(idle_warnings(settings({}, document)))


@pytest.mark.parametrize(
    ("own", "descriptor", "flags", "is_idle"),
    [
        ({"max_restarts": 2}, "", {}, True),
        ({"restart_delay": "1s"}, "never", {}, True),
        ({"max_restarts": 2, "restart_policy": "no"}, "always", {}, True),
        ({"max_restarts": 2}, "on-failure", {}, False),
        ({"max_restarts": 2}, "", {"restart_policy": "always"}, False),
        ({"max_restarts": 2, "owes": OWES}, "", {}, False),
        ({"nice": 3}, "", {}, False),
    ],
)
def test_a_budget_of_a_node_that_dora_never_restarts(
    own: dict[str, object], descriptor: str, flags: dict[str, object], is_idle: bool
) -> None:
    policy = {"restart_policy": descriptor} if descriptor else {}
    node = {"id": "camera", "path": "camera.py", "outputs": ["image"], **policy}
    dataflow = parse_dataflow({"nodes": [node]}, "/srv/robot/dataflow.yml")
    given = runner(settings(flags, {"nodes": {"camera": own}}))
    expected = f"{next(iter(own))} of the node camera has no effect: its restart_policy is no"
    assert list(idle_budgets(dataflow, given)) == ([expected] if is_idle else [])


def test_default_restarts_nothing() -> None:
    assert restart_of(runner(settings({}))).policy == "no"
    # A bare `no` is false in YAML.
    assert restart_of(runner(settings({}, {"restart_policy": False}))).policy == "no"


def test_warnings() -> None:
    warnings = list(idle_warnings(settings({"max_restarts": "3"})))
    assert warnings == ["--max-restarts has no effect without --restart-policy"]
    assert not list(idle_warnings(settings({"max_restarts": "3", "restart_policy": "always"})))
    nodes = {"nodes": {"camera": {"restart_policy": "always"}}}
    assert not list(idle_warnings(settings({"max_restarts": "3"}, nodes)))
    given: dict[str, object] = {"watch": ("*.py",), "ignore": ("a",), "replace": "start-first"}
    assert list(idle_warnings(settings(given))) == [
        "--watch has no effect without --hot-reload",
        "--ignore has no effect without --hot-reload",
    ]
    assert not list(idle_warnings(settings({**given, "hot_reload": True})))
    nodes = {"nodes": {"camera": {"watch": "*.bin"}}}
    warning = "--node camera:watch has no effect without --hot-reload"
    assert list(idle_warnings(settings({"nodes": ["b:nice=3"]}, nodes))) == [warning]
    assert not list(idle_warnings(settings({"hot_reload": True}, nodes)))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"watch": ["*.py"]}, "cannot use --watch without --hot-reload"),
        ({"ignore": ["*.py"]}, "cannot use --ignore without --hot-reload"),
        ({"max_restarts": "3"}, "cannot use --max-restarts without --restart-policy"),
        ({"max_restarts": "3", "restart_policy": "always"}, ""),
    ],
)
def test_a_flag_without_effect_is_refused(flags: dict[str, object], message: str) -> None:
    """A settings file may have the key."""
    require_effect(settings({}, flags), flags)
    if not message:
        require_effect(settings(flags), flags)
        return
    with pytest.raises(DoraSystemdError, match=message) as caught:
        require_effect(settings(flags), flags)
    assert caught.value.code is ExitCode.USAGE


def test_a_flag_for_one_node_without_effect_is_refused() -> None:
    flags: dict[str, object] = {"nodes": ["a:watch=*.py"]}
    with pytest.raises(DoraSystemdError, match="cannot use --node a:watch without") as caught:
        require_effect(settings(flags), flags)
    assert caught.value.hint == "add --hot-reload, or write watch in a settings file"
    require_effect(settings(flags), {"hot_reload"})
    require_effect(settings({**flags, "hot_reload": True}), flags)
    document = {"nodes": {"b": {"watch": "*.py"}}}
    require_effect(settings({"nodes": ["a:memory_limit=1G"]}, document), flags)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("restart_policy", "never"),
        ("restart_policy", "on-success"),
        ("max_restarts", "0"),
        ("max_restarts", "-1"),
        ("max_restarts", "many"),
        ("max_restarts", "٣"),
        ("max_restarts", "9" * 5000),
        ("restart_delay", "-1"),
        ("restart_delay", "infinity"),
        ("restart_window", "0"),
        ("start_timeout", "0"),
    ],
)
def test_bad_values(name: str, text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        settings({name: text})
    assert caught.value.code is ExitCode.USAGE
    assert caught.value.message.startswith("cannot ")
    assert ("restart" in caught.value.message) == (name != "start_timeout")
    assert caught.value.hint


@pytest.mark.parametrize(
    ("given", "delay"),
    [
        ({"restart_delay": 0}, 0),
        ({"restart_delay": "100ms"}, SECOND // 10),
        ({"restart_delay": 0, "max_restarts": 1200}, 0),
        ({"restart_delay": 0, "max_restarts": 9, "restart_window": "infinity"}, 0),
        ({"restart_delay": "500ms", "max_restarts": "infinity"}, SECOND // 2),
    ],
)
def test_a_restart_at_once(given: dict[str, object], delay: int) -> None:
    policy = restart_of(runner(settings({}, given)))
    assert (policy.delay, policy.delay_before(1)) == (delay, delay)
    assert unit(policy._replace(policy="always"))["RestartSec"] == max(delay - HEAD_START, 0)


@pytest.mark.parametrize(
    "given",
    [
        {"restart_delay": 0, "max_restarts": 1201},
        {"restart_delay": 0, "max_restarts": "infinity"},
        {"restart_delay": 0, "restart_window": "2s"},
        {"restart_delay": "499ms", "max_restarts": "infinity", "restart_window": "infinity"},
    ],
)
@pytest.mark.parametrize("is_node", [False, True])
def test_a_crash_loop_that_would_not_end(given: dict[str, object], is_node: bool) -> None:
    document = {"nodes": {"camera": given}} if is_node else given
    with pytest.raises(DoraSystemdError, match=r"^cannot use restart_delay") as caught:
        runner(settings({}, document))
    assert ("of the node 'camera'" in caught.value.message) == is_node
    assert "500ms or more" in caught.value.hint
    assert FILE in caught.value.message
    assert caught.value.code is ExitCode.BAD_INPUT
    with pytest.raises(DoraSystemdError, match=r"^cannot use restart_delay") as caught:
        runner(settings({"max_restart_delay": "1min"}, document))
    assert FILE not in caught.value.message
    assert caught.value.code is ExitCode.USAGE


def node(raw: dict[str, Any], policy: RestartPolicy = DEFAULT, ident: str = "") -> dict[str, Any]:
    """The keys of the node `n`. policy: of the node `ident`, or of the dataflow."""
    flow = parse_dataflow({"nodes": [{"id": "n", "path": "a.py", **raw}]}, "flow.yml")
    given = plan(settings=with_restart(options(), policy, ident).settings)
    launched: dict[str, Any] = launch_descriptor(flow, given)["nodes"][0]
    return {key: launched[key] for key in launched if "restart" in key}


DORA = {
    "restart_policy": "on-failure",
    "max_restarts": 3,
    "restart_delay": 1.0,
    "max_restart_delay": 8.0,
    "restart_window": 600.0,
}


def test_nodes_that_state_nothing_get_the_policy() -> None:
    assert node({}) == {}
    assert node({}, POLICY) == DORA
    assert node({"restart_policy": "never"}, POLICY) == {"restart_policy": "never"}


def test_the_settings_of_a_node_win() -> None:
    given = {"restart_policy": "always", "max_restarts": 9}
    assert node(given, POLICY, "n") == DORA
    assert node(given, DEFAULT, "n")["restart_policy"] == "never"


@pytest.mark.parametrize(
    ("raw", "given", "expected"),
    [
        (
            {"restart_policy": "always", "max_restarts": 9, "restart_window": 5},
            {"max_restarts": 3},
            ("always", 3, 0.5, 30.0, 5),
        ),
        (
            {"restart_policy": "on-failure", "max_restarts": 9},
            {"restart_delay": "40s", "restart_window": "1min"},
            ("on-failure", 9, 40.0, 40.0, 60.0),
        ),
        (
            {"restart_policy": "on-failure", "max_restarts": 10**6},
            {"restart_delay": 0, "restart_window": "infinity"},
            ("on-failure", 10**6, 0.5, 30.0, None),
        ),
        (
            {"restart_policy": "on-failure", "restart_delay": 60},
            {"max_restart_delay": "1s"},
            ("on-failure", None, 60.0, 60.0, None),
        ),
        ({"restart_policy": "never"}, {"max_restarts": 3}, ("never", None, None, None, None)),
        (
            {"restart_policy": "never", "outputs": ["image"]},
            {"max_restarts": 3, "owes": OWES},
            ("on-failure", 3, 0.5, 30.0, 600.0),
        ),
        ({}, {"max_restarts": 3}, ("never", None, None, None, None)),
        ({"restart_policy": "always"}, {"restart_policy": "no"}, ("never", *[None] * 4)),
    ],
)
def test_a_budget_alone_keeps_the_policy_in_the_dataflow_file(
    raw: dict[str, Any], given: dict[str, object], expected: tuple[object, ...]
) -> None:
    flow = parse_dataflow({"nodes": [{"id": "n", "path": "a.py", **raw}]}, "flow.yml")
    given_settings = runner(settings({}, {"nodes": {"n": given}})).settings
    (launched,) = launch_descriptor(flow, plan(settings=given_settings))["nodes"]
    assert tuple(map(launched.get, DORA)) == expected


def test_endless() -> None:
    keys = POLICY._replace(max_restarts=INFINITY, window=INFINITY).dora_keys()
    assert keys["max_restarts"] == 0
    assert "restart_window" not in keys


def unit(policy: RestartPolicy, **changes: Any) -> dict[str, Any]:
    given = with_restart(options(**changes), policy)
    return {key: one.value for key, one in restart_properties(given).items()}


def test_systemd_counts_what_the_runner_does_not() -> None:
    """Starts by hand count for systemd, too."""
    found = unit(POLICY)
    assert (found["Restart"], found["StartLimitBurst"]) == ("on-failure", 34)
    assert found["StartLimitIntervalSec"] == 10 * MINUTE
    assert found["RestartSec"] == SECOND * 3 // 5
    assert "RestartSteps" not in found, "it never forgets"
    assert unit(POLICY._replace(max_restarts=64))["StartLimitBurst"] == 65, "systemd alone counts"
    assert found["RestartPreventExitStatus"] == ((70, 72, 75, 77, 78), ())


def test_delays_double_up_to_the_longest() -> None:
    delays = [POLICY.delay_before(restart) // SECOND for restart in (0, 1, 2, 3, 4, 5, 10**6)]
    assert delays == [1, 1, 2, 4, 8, 8, 8]


def test_unit_without_restarts() -> None:
    assert unit(DEFAULT) == {
        "Restart": "no",
        "RestartPreventExitStatus": ((70, 72, 75, 77, 78), ()),
        "RestartForceExitStatus": ((), (6,)),  # of the watchdog, which says nothing of the nodes
    }
    attached = unit(POLICY, attached=True)["RestartPreventExitStatus"]
    assert attached == ((0, 70, 71, 72, 75, 77, 78), ())
    assert unit(POLICY._replace(max_restarts=INFINITY))["StartLimitIntervalSec"] == 0


@pytest.mark.parametrize(
    ("starts", "now", "counted", "expected"),
    [
        ([], 5, 0, Budget(0, None)),
        ([0, 1, 2], 5, 2, Budget(2, 5)),
        ([0, 1, 2, 3, 4, 5], 5, 5, Budget(3, 5)),
        # The window of the first start is over: the next start began another one.
        ([0, 9, 11, 12], 13, 3, Budget(1, 8)),
        ([0, 1], 10, 1, Budget(0, None)),
        # Cleared by `doractl reset`.
        ([0, 1, 2], 5, 0, Budget(0, None)),
    ],
)
def test_budget(starts: list[int], now: int, counted: int, expected: Budget) -> None:
    assert unit_budget(starts, 3, 10, now, counted) == expected


def test_words() -> None:
    budget = {"used": 3, "max": 5, "next_us": 39_100_000, "resets_us": 480 * SECOND}
    assert budget_words(budget) == (
        "3/5 restarts of the dataflow used, next try in 40s, resets in 8min"
    )
    assert budget_words({"used": 0, "max": 5, "next_us": None, "resets_us": None}) == (
        "0/5 restarts of the dataflow used"
    )
