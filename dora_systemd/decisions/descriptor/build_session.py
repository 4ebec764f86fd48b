"""The session that `dora build` saves for `dora start`: out/<stem>.dora-session.yaml."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath


@dataclass(frozen=True)
class BuildSession:
    """The results of the last `dora build`, by node id, as absolute paths.

    directories: where a node runs; for one from git that is its clone. envs: virtual environments
    of `dora build --uv`; without --uv they do not exist.
    """

    directories: Mapping[str, str] = field(default_factory=dict)
    envs: Mapping[str, str] = field(default_factory=dict)


def session_path(dataflow: str) -> PurePath:
    """The session file of the descriptor at `dataflow`."""
    path = PurePath(dataflow)
    return path.parent / "out" / f"{path.stem}.dora-session.yaml"


def parse_session(document: object) -> BuildSession:
    """The session in a loaded YAML document; empty if dora did not write it."""
    build = document.get("local_build") if isinstance(document, dict) else None
    if not isinstance(build, dict):
        return BuildSession()
    directories, envs = (build.get(key) for key in ("node_working_dirs", "python_env_dirs"))
    return BuildSession(_texts(directories), _texts(envs))


def _texts(value: object) -> dict[str, str]:
    return {str(key): str(text) for key, text in value.items()} if isinstance(value, dict) else {}
