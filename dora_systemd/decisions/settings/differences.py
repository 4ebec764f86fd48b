"""Compares settings: two versions of a settings file, and the options of two deploys. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.limits import BY_KEY, NodeLimits, SettingsChange, node_limits
from dora_systemd.decisions.settings.limits import NODE_LIMIT
from dora_systemd.decisions.settings.resolve import Settings, runner_texts
from dora_systemd.decisions.settings.table import ENV, PROPERTY, SETTINGS, WORKING_DIRECTORY
from dora_systemd.values import INFINITY

_USUAL_WEIGHT = 100


def settings_change(before: Settings, after: Settings) -> SettingsChange:
    """The settings in `after`, made from one file only, that differ from `before`."""
    old, new = (_by_node(settings) for settings in (before, after))
    changed = [_changed(node, old.get(node, {}), new.get(node, {})) for node in {**old, **new}]
    own = {key for key in before.values if before.values[key] != after.values[key]}
    nodes = {
        f"nodes.{node}.{key}"
        for node in {**before.nodes, **after.nodes}
        for key, _ in _items(before, node) ^ _items(after, node)
        if key not in BY_KEY
    }
    others = sorted(own - {NODE_LIMIT.name}) + sorted(nodes)
    return SettingsChange(tuple(one for one in changed if one.limits), tuple(others))


def _by_node(settings: Settings) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for one in runner_texts(settings):
        if one.node and (limit := BY_KEY.get(one.key)):
            found.setdefault(one.node, {})[limit.word] = limit.parse(one.text)
    return found


def _changed(node: str, old: Mapping[str, int], new: Mapping[str, int]) -> NodeLimits:
    """The new limits; a limit that is missing now is removed."""
    gone = {word: _USUAL_WEIGHT if "weight" in word else INFINITY for word in old.keys() - new}
    return node_limits(node, {**{w: v for w, v in new.items() if old.get(w) != v}, **gone})


def _items(settings: Settings, node: str) -> set[tuple[str, str]]:
    values: Mapping[str, Any] = settings.nodes.get(node, {})
    return {(key, repr(value)) for key, value in values.items()}


Texts = Mapping[str, str | Sequence[str]]
"""Options by name of the setting, as of given_texts()."""
_WITHOUT_VALUES = (ENV, PROPERTY, WORKING_DIRECTORY)
"""Settings that are shown without values: secrets, or a directory that is gone."""


def lost_options(former: Texts, now: Texts, settings: Settings) -> list[str]:
    """List the options that `former` has, as flags, and that nothing gives a value for now.

    settings: of now; a settings file counts as well.
    """
    found = []
    for setting in SETTINGS:
        value = former.get(setting.name)
        if value is None or setting.name in now or settings.is_given(setting):
            continue
        flag = setting.flags[0]
        texts = [value] if isinstance(value, str) else list(value)
        if setting.kind.is_flag:
            found.append(flag if texts == ["yes"] else f"--no-{flag.removeprefix('--')}")
        elif setting in _WITHOUT_VALUES:
            found.append(flag)
        else:
            found += [f"{flag} {text}" for text in texts]
    return found
