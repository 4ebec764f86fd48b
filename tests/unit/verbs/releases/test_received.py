"""Whole deploys of a project that another host sends."""

import json
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dora_systemd.adapters.releases.transfer import Stream, spooled
from dora_systemd.decisions.releases.parcel import Parcel, format_parcel
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import SECOND
from dora_systemd.verbs.releases.deploy import Deployed
from dora_systemd.verbs.releases.receive import receive
from dora_systemd.verbs.releases.rollback import roll_back
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.deploys import FLOW, Bench
from tests.unit.fakes.manager import options

REVISION = "1" * 40


class Sender(Bench):
    """Sends its project. answers: those of the receiver. is_gone: it hangs up during the trial."""

    is_gone = False

    def send(self, texts: Mapping[str, str], **head: object) -> Deployed:
        """Send these files and what the receiver asks for."""
        with spooled() as spool:
            stored = {path: spool.write("", [text.encode()], False) for path, text in texts.items()}
        whole: dict[str, object] = {"directory": None, "revision": REVISION, "files": stored}
        given: dict[str, Any] = {"dataflow": "dataflow.yml", **whole, **head}
        parcel = Parcel("robot", "/home/ann/robot", **given)
        by_digest = {stored[path].digest: text for path, text in texts.items()}
        reading, writing = os.pipe()
        os.write(writing, format_parcel(parcel))
        self.answers: list[str] = []

        def answer(line: str) -> None:
            self.answers.append(line)
            for number in json.loads(line)["wants"]:
                os.write(writing, by_digest[parcel.contents[number].digest].encode())

        if self.is_gone:
            self.manager.on_start = lambda: self._hang_up(writing)
        request = self.request()
        start = StartRequest("", flags={"dora": self.dora})
        request = replace(request, start=start, soak=3600 * SECOND if self.is_gone else 0)
        tell, warn = self.steps.append, self.warnings.append
        stream, before = Stream(reading), _watchers()
        try:
            return receive(self.manager, self.scope, request, stream, answer, tell, warn)
        finally:
            # Else the end of the stream would end this process.
            assert _watchers() == before
            os.close(reading)
            if not self.is_gone:
                os.close(writing)

    def _hang_up(self, fd: int) -> None:
        self.manager.on_start = lambda: None
        os.close(fd)
        time.sleep(60)  # until the signal comes


def _watchers() -> list[threading.Thread]:
    return [one for one in threading.enumerate() if one.daemon]


FILES = {"dataflow.yml": FLOW, "a.py": "print()", "b.py": "print()"}


@pytest.fixture
def sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sender:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return Sender(tmp_path)


def test_what_is_sent_is_deployed(sender: Sender) -> None:
    done = sender.send(FILES)
    assert sender.answers == ['{"wants": [0, 1]}'], "each content once"
    manifest = sender.store.manifest(done.release)
    facts = (manifest.source, manifest.revision, manifest.dataflow, done.files, done.copied)
    assert facts == ("/home/ann/robot", REVISION, "dataflow.yml", 3, 43)
    assert sender.texts[:2] == ["copying: 0B of 36B", "copying: 29B of 36B"]
    tree = sender.store.tree(done.release)
    assert {path: (tree / path).read_text() for path in FILES} == FILES
    assert sender.releases == {done.release: "current"}
    assert not (tree.parents[2] / ".sent").exists()


def test_only_what_is_missing_is_asked_for(sender: Sender) -> None:
    first = sender.send(FILES)
    second = sender.send({**FILES, "b.py": "print(2)"})
    assert sender.answers == ['{"wants": [2]}']
    assert (second.former, second.copied, second.uuid) == (first.release, 8, first.uuid)
    same = [sender.store.tree(one.release) / "a.py" for one in (first, second)]
    assert same[0].samefile(same[1])


def test_a_working_directory_that_is_sent(sender: Sender) -> None:
    files = {f"flows/{name}": text for name, text in FILES.items()} | {"a.py": "print()"}
    done = sender.send(files, dataflow="flows/dataflow.yml", directory=".")
    tree = sender.store.tree(done.release)
    assert f"--working-directory={tree} " in sender.store.unit(done.release)
    assert sender.store.manifest(done.release).dataflow == "flows/dataflow.yml"


def test_errors_name_the_project_as_the_sender_does(sender: Sender) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        sender.send({**FILES, "dataflow.yml": "nodes: 7\n"})
    assert "/home/ann/robot/dataflow.yml" in caught.value.message
    assert str(sender.store.path.parent) not in caught.value.message + caught.value.hint
    assert sender.releases == {}


def test_warnings_of_a_deploy_reach_the_sender(sender: Sender) -> None:
    first = sender.deploy(nice="3")
    sender.warnings.clear()
    sender.send(FILES)
    (warning,) = sender.warnings
    assert warning.startswith(f"options of release {first.release} are not given any more: --nice")


def test_a_sender_that_hangs_up_ends_the_trial(sender: Sender) -> None:
    first = sender.send(FILES)
    sender.is_gone = True
    with pytest.raises(DoraSystemdError) as caught:
        sender.send(FILES)
    assert caught.value.code is ExitCode.ROLLED_BACK
    assert "the command was interrupted" in caught.value.message
    assert [*sender.releases.values()] == ["current", "unproved"]
    assert next(iter(sender.releases)) == first.release


def test_what_start_has_started_is_not_replaced(sender: Sender) -> None:
    sender.manager.add(options())
    with pytest.raises(DoraSystemdError) as caught:
        sender.send(FILES)
    assert caught.value.code is ExitCode.NAME_IN_USE
    assert sender.answers == [], "nothing has been sent for it"


def test_what_is_sent_goes_through_the_same_decisions(sender: Sender) -> None:
    """A bad release, its rollback and the next one: neither --keep nor a rollback confuse them."""
    good, bad = (sender.send({**FILES, "b.py": f"print({n})"}).release for n in range(2))

    def go_back() -> str:
        return roll_back(
            sender.manager, sender.scope, "robot", None, 0, sender.steps.append
        ).release

    assert go_back() == good
    third = sender.send({**FILES, "b.py": "print(3)"}).release
    assert sender.releases == {good: "proved", bad: "rolled-back", third: "current"}
    sender.manager.state = "failed"
    with pytest.raises(DoraSystemdError):
        sender.send({**FILES, "b.py": "print(4)"})
    sender.manager.state = "active"
    assert go_back() == good
    assert [*sender.releases.values()] == ["current", "rolled-back", "failed"]
