"""What of a changed settings file can be taken over at once."""

from dora_systemd.decisions.cell.options import format_setting
from dora_systemd.decisions.settings.differences import settings_change
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings


def of(document: object) -> Settings:
    return resolve_settings({}, {}, [("/p/robot.systemd.yml", document)])


def change(before: object, after: object) -> tuple[list[str], list[str]]:
    texts, others = settings_change(of(before), of(after))
    return [format_setting(one) for one in texts], others


def test_nothing() -> None:
    assert change(None, {}) == ([], [])
    same = {"env": {"A": "b"}, "nodes": {"a": {"memory_limit": "1G"}}}
    assert change(same, same) == ([], [])


def test_limits_of_nodes() -> None:
    before = {"nodes": {"a": {"memory_limit": "1G", "cpu_weight": 50}, "b": {"cpu_limit": 1}}}
    after = {"nodes": {"a": {"memory_limit": "2G"}, "c": {"tasks_limit": 9}}}
    limits, others = change(before, after)
    assert limits == [
        *("a:memory_limit=2G", "a:cpu_weight=100"),
        *("b:cpu_limit=infinity", "c:tasks_limit=9"),
    ]
    assert others == []


def test_all_else_is_named() -> None:
    after = {"memory_limit": "1G", "nodes": {"a": {"replace": "start-first"}}}
    assert change({"env": {"A": "b"}}, after) == (
        [],
        ["env", "memory_limit", "nodes.a.replace"],
    )
