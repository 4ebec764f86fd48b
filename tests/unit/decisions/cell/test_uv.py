"""The project of `uv run`."""

import pytest

from dora_systemd.decisions.cell.uv import uv_project

MEMBER = '[project]\nname = "robot"\n'
WORKSPACE = '[tool.uv.workspace]\nmembers = ["./apps/*", 5]\nexclude = ["apps/old"]\n'


@pytest.mark.parametrize(
    ("directory", "files", "project"),
    [
        ("/w/apps/robot", {}, None),
        ("/w/apps/robot/flows", {"/w/apps/robot": MEMBER}, "/w/apps/robot"),
        ("/w/apps/robot/flows", {"/w/apps/robot": MEMBER, "/w": WORKSPACE}, "/w"),
        ("/w/flows", {"/w": WORKSPACE}, "/w"),
        ("/w/apps/old", {"/w/apps/old": MEMBER, "/w": WORKSPACE}, "/w/apps/old"),
        ("/w/apps/a/b", {"/w/apps/a/b": MEMBER, "/w": WORKSPACE}, "/w/apps/a/b"),
        ("/w/lib", {"/w/lib": MEMBER, "/w": WORKSPACE}, "/w/lib"),
        # The nearest one above decides, and a workspace is no member.
        ("/w/apps/a", {"/w/apps/a": MEMBER, "/w/apps": MEMBER, "/w": WORKSPACE}, "/w/apps/a"),
        ("/w/apps/a", {"/w/apps/a": "[tool.uv.workspace]", "/w": WORKSPACE}, "/w/apps/a"),
        ("/w/apps/a", {"/w/apps/a": "no [toml", "/w": "\udcff"}, "/w/apps/a"),
        ("/w/apps/a", {"/w/apps/a": "", "/w": WORKSPACE + "#" * 70_000}, "/w/apps/a"),
        ("/w/apps/a", {"/w/apps/a": "", "/w": "tool = {uv = {workspace = 5}}"}, "/w/apps/a"),
        ("/w/apps/a", {"/w/apps/a": "", "/w": "x = " + "[" * 5000}, "/w/apps/a"),
        ("/w/a", {"/w/a": "", "/w": "[tool.uv.workspace]\nmembers = 5"}, "/w/a"),
    ],
)
def test_which_project(directory: str, files: dict[str, str], project: str | None) -> None:
    def read(path: str) -> bytes:
        place, _, name = path.rpartition("/")
        assert name == "pyproject.toml"
        if place not in files:
            raise FileNotFoundError(path)
        return files[place].encode("utf-8", "surrogateescape")

    assert uv_project(directory, read) == project
