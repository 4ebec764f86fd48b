"""Which files mean a reload."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.decisions.reload.watch_rules import (
    DEFAULT_WATCH,
    WatchRules,
    parse_patterns,
    relative_patterns,
    unmatched_patterns,
)
from dora_systemd.errors import DoraSystemdError, ExitCode


@pytest.mark.parametrize(
    "path",
    ["a.py", "dataflow.yml", "sub/deep/a.py", "config/lens.toml", "camera.json", ".env", "a b.py"],
)
def test_what_means_a_reload(path: str) -> None:
    assert WatchRules("/p").has(f"/p/{path}")


@pytest.mark.parametrize(
    "path",
    [
        *("a.log", "out/x/log_a.jsonl", "tmp/a.py", "a.py~", ".a.py.swp", "#a.py#", ".#a.py"),
        *("4913", ".git/HEAD", ".git/a.py", ".venv/lib/a.py", "venv/a.py", "__pycache__/a.py"),
        *("build/a.py", "target/a.json", "data/a.json", "a.csv", "a.txt", "sub/site-packages/x.py"),
    ],
)
def test_what_does_not(path: str) -> None:
    assert not WatchRules("/p").has(f"/p/{path}")


def test_outside() -> None:
    rules = WatchRules("/p")
    assert not rules.has("/q/a.py")
    assert not rules.has("/pa.py")
    assert not rules.has("/p")


def test_own_patterns() -> None:
    rules = WatchRules("/p", ("*.py", "config/*"), ("test_*",))
    paths = ("a.py", "config/x", "config/y/x", "sub/config/x", "a.yml", "test_a.py")
    assert [path for path in paths if rules.has(f"/p/{path}")] == ["a.py", "config/x", "config/y/x"]


def test_what_git_ignores() -> None:
    ignores = {"": ("/gen/", "!kept.py", "*.local.py"), "sub": ("x.py",)}
    rules = WatchRules("/p", gitignores=ignores)
    assert not rules.has("/p/gen/a.py")
    assert not rules.has("/p/deep/a.local.py")
    assert not rules.has("/p/sub/x.py")
    assert rules.has("/p/x.py")
    assert rules.has("/p/sub/a.py")


@pytest.mark.parametrize("line", ["!", "\\", "x\\", "!\\", "[z-a]"])
def test_lines_that_git_takes_for_nothing(line: str) -> None:
    rules = WatchRules("/p", gitignores={"": (line, "*.local.py")})
    assert rules.has("/p/x.py")
    assert not rules.has("/p/x.local.py")


def test_directories() -> None:
    rules = WatchRules("/p", gitignores={"": ("/gen/",)})
    places = ["/p", "/p/sub", "/p/.git", "/p/sub/.venv", "/p/gen", "/p/out", "/q"]
    assert [place for place in places if rules.has_directory(place)] == ["/p", "/p/sub"]


def test_lists_of_patterns() -> None:
    assert parse_patterns(["*.py, *.yaml,", "config/*"]) == ("*.py", "*.yaml", "config/*")


@pytest.mark.parametrize("text", ["../x/*.py", "a\nb", "x/../../y", "!", "x\\", "[z-a]"])
def test_bad_patterns(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        parse_patterns([text])
    assert caught.value.code is ExitCode.USAGE


def test_absolute_patterns() -> None:
    assert relative_patterns(["*.py", "/p/config/*"], "/p") == ("*.py", "/config/*")
    with pytest.raises(DoraSystemdError) as caught:
        relative_patterns(["/etc/*.conf"], "/p")
    assert caught.value.message == "cannot watch '/etc/*.conf': it is outside of /p"


def test_patterns_that_match_nothing() -> None:
    rules = WatchRules("/p", ("*.py", "*.toml", "config/*"))
    paths = ["/p/a.py", "/p/out/a.toml"]
    assert unmatched_patterns(rules, paths) == ("*.toml", "config/*")


@given(st.text(min_size=1), st.sampled_from(DEFAULT_WATCH))
def test_any_path(path: str, pattern: str) -> None:
    rules = WatchRules("/p", (pattern,))
    assert isinstance(rules.has(f"/p/{path}"), bool)
