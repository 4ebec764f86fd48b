"""The life events of a dataflow: name -> what the journal gets.

units/templates/dora-systemd.catalog explains each MESSAGE_ID to `journalctl -x`; a test compares
the two. Never change or reuse a MESSAGE_ID: https://systemd.io/CATALOG
"""

from typing import NamedTuple

from dora_systemd.decisions.logs.lines import ERR, INFO, NOTICE, WARNING, Value, legal_name


class EventKind(NamedTuple):
    """One kind of event."""

    message_id: str
    priority: int
    text: str  # may contain `{dataflow}`, `{node}` and `{count}`


def _dataflow(message_id: str, priority: int, text: str) -> EventKind:
    return EventKind(message_id, priority, f"Dataflow {{dataflow}} {text}")


EVENTS = {
    "dataflow-starting": _dataflow("0486727a2190411eb78f66e816da2520", INFO, "is starting"),
    "dataflow-started": _dataflow(
        "c8e3833d172d44c5a32de08c980c4d67", NOTICE, "is running, all nodes are ready"
    ),
    "dataflow-stopping": _dataflow("822b051bbbe24788bf93c0952aafa491", INFO, "is stopping"),
    "start-asked": EventKind(
        "1a28e80e37394313a9ddb940986531e3", INFO, "Start of dataflow {dataflow} requested by {by}"
    ),
    "stop-asked": EventKind(
        "958c39b63a3d47cd9dd585937d57d927", INFO, "Stop of dataflow {dataflow} requested by {by}"
    ),
    "inhibited": EventKind(
        "6e439f1e51f147df87eb35cdd8e61cb1", INFO, "Dataflow {dataflow} inhibited by {by}"
    ),
    "dataflow-forgotten": EventKind(
        "4fce1228a6ba409ca61424d2cc89ddc5", NOTICE, "Dataflow {dataflow} forgotten by {by}"
    ),
    "dataflow-finished": _dataflow("61a9895e49214871ae2381a42f2a1968", NOTICE, "finished"),
    "dataflow-stopped": _dataflow("5e9f54e3c8fa448fab7d9114ae8f8e87", NOTICE, "was stopped"),
    "dataflow-failed": _dataflow("99f4f6038d0146de8190e12fc9726881", ERR, "failed"),
    "node-ready": EventKind("b365b9011367406fafffd2bbd63d5693", INFO, "Node {node} is ready"),
    "node-exited": EventKind("617721968a69470486dcfe591e37fd3c", INFO, "Node {node} exited"),
    "node-crashed": EventKind("c2afc7aa5aac4b8882b951d397ce9297", ERR, "Node {node} crashed"),
    "node-ended": EventKind("7d79b85f556347d18561d021d884cc39", ERR, "Node {node} was ended"),
    "node-restarted": EventKind(
        "436622a1703a4db68ed8a1aac4ddc336", WARNING, "Node {node} is being restarted by dora"
    ),
    "node-asked": EventKind(
        "4a47fed288b84bba8f92865ae43618ed",
        NOTICE,
        "Node {node}: {asked} requested by {by}",
    ),
    "node-oom": EventKind("1e5f89981faf4b0ba7cd69e0b844f9a3", ERR, "Node {node} was killed"),
    "dataflow-oom": _dataflow(
        "074b91207b234b46973343bb14a637a9", ERR, "has used up its memory limit"
    ),
    "memory-pressure": _dataflow(
        "df01123a855d446d8a751cc3e2f99656", WARNING, "is close to a memory limit"
    ),
    "cpu-throttled": _dataflow(
        "1c40798a51c14a89a416ed625e0afc1a", NOTICE, "is throttled by a CPU limit"
    ),
    "node-waiting": EventKind(
        "620e56b40d464810bebfe137b63a04d0", NOTICE, "Node {node} waits for what it needs"
    ),
    "node-needs-met": EventKind(
        "6850a7771eb341d2a6c6b88f29b11c48", NOTICE, "Node {node} has what it needs"
    ),
    "node-hung": EventKind("6bb24464fee34a848c077fc1b20c1802", ERR, "Node {node} hangs"),
    "node-watchdog": EventKind(
        "5bec2bc650014ae7bb1424da4204438f", ERR, "Node {node} is ended by its watchdog"
    ),
    "node-stop-late": EventKind(
        "dcee148c33f9474391d52960af3b00c4", WARNING, "Node {node} has not stopped in its time"
    ),
    "container-outside": EventKind(
        "33bd31ef93fe4f4e880dbb72e705e366",
        NOTICE,
        "Node {node} has started a container of {program} outside of its cgroup",
    ),
    "notify-refused": EventKind(
        "1bd51be61e0640ab97f9b364c5014cf0",
        WARNING,
        "Notify socket of node {node} got a message from another process",
    ),
    "node-silent": EventKind("0423ade5276f4005ae23065ff68dc1f8", WARNING, "Node {node} is silent"),
    "node-speaks-again": EventKind(
        "2111b5e58ac74a9eb7d68402c07184b9", NOTICE, "Node {node} speaks again"
    ),
    "outputs-unwatched": _dataflow(
        "363dd20a3ce94006a65ba740609decd3", WARNING, "has owed outputs that nobody watches"
    ),
    "outputs-unrecorded": _dataflow(
        "cf425f10f51b4fcfb93a10956310c0d0", WARNING, "has outputs that nobody records"
    ),
    "coordinator-lost": EventKind(
        "11b7330be3fb484584286f274012f05a", ERR, "The coordinator of dataflow {dataflow} is lost"
    ),
    "daemon-lost": EventKind(
        "4252b5e8e29d4cc4be2e3acdae5f3da4", ERR, "The daemon of dataflow {dataflow} is lost"
    ),
    "machine-joined": EventKind(
        "e0d2372561f3493282a806ca38df17b4",
        INFO,
        "Machine {machine} has joined dataflow {dataflow}",
    ),
    "machine-lost": EventKind(
        "6a7f135594054f938f48dc3677136db0",
        WARNING,
        "Machine {machine} of dataflow {dataflow} is lost",
    ),
    "machine-back": EventKind(
        "43c4e922fa22473fb5a01ef7c1346ef0",
        NOTICE,
        "Machine {machine} of dataflow {dataflow} is back",
    ),
    "machine-differs": EventKind(
        "369099ed589847a999a2ba58e394ab40",
        WARNING,
        "Files of machine {machine} of dataflow {dataflow} differ",
    ),
    "reloaded": _dataflow("6ddc74129bfd4d61bd13747edb506634", NOTICE, "was reloaded"),
    "files-changed": EventKind("902dc080ec514a37b5dfa7ecceb95347", INFO, "File changed: {files}"),
    "node-reloaded": EventKind("4c9f8decbcc94dfbb46948d6c865191d", NOTICE, "Node {node} was {how}"),
    "reload-failed": _dataflow("47ac7b36b7204f468199e716c9176175", WARNING, "was not reloaded"),
    "lines-lost": EventKind(
        "d880d0e56bbe4318ac5ac2afbb8cb42f",
        WARNING,
        "{count} log lines of dataflow {dataflow} are lost",
    ),
    "lines-suppressed": EventKind(
        "c1c721542288459ebe040a240a583d9d",
        WARNING,
        "{count} log lines of node {node} exceed its limit of {limit}",
    ),
    "release-committed": EventKind(
        "a59dc340b5c54c1eb7422b0a5484d078",
        NOTICE,
        "Release {release} of dataflow {dataflow} has passed its trial",
    ),
    "release-rolled-back": EventKind(
        "f058b93d20854c7a9b807cb93ae78efb",
        WARNING,
        "Release {release} of dataflow {dataflow} was rolled back",
    ),
    "node-given-up": EventKind("d96c6b0794944af2a5cfba088b5d31ec", ERR, "Node {node} is given up"),
    "notice-sent": EventKind(
        "4b9fd4f8ba98421b984bb7516521b9dc", NOTICE, "Notice about dataflow {dataflow} is sent"
    ),
    "notice-failed": EventKind(
        "e7cce21261c04ef187daa5f0fea38c01",
        WARNING,
        "Notice about dataflow {dataflow} is not sent",
    ),
    "bundle-written": EventKind(
        "bc2beafec775423d869cf2b811d8d1ab",
        NOTICE,
        "Bundle of dataflow {dataflow} is written: {file}",
    ),
    "bundle-refused": EventKind(
        "7ff052b3d4004d2e9bc47b79ca330729",
        WARNING,
        "Bundle of dataflow {dataflow} is not written",
    ),
    "build-failed": EventKind(
        "c598b7b44f614a64a048fc856c696082",
        WARNING,
        "Release {release} of dataflow {dataflow} could not be built",
    ),
}

STARTING, STARTED, STOPPING = "dataflow-starting", "dataflow-started", "dataflow-stopping"
# Each life of a dataflow ends with one of these, unless the runner was killed.
CLEAN_ENDS = ("dataflow-finished", "dataflow-stopped")
END_EVENTS = (*CLEAN_ENDS, "dataflow-failed")
# Each life of a node's process ends with one of these.
NODE_FAILURES = ("node-crashed", "node-ended", "node-oom")
NODE_END_EVENTS = ("node-exited", *NODE_FAILURES)

START_ASKED, STOP_ASKED = "start-asked", "stop-asked"
ROLLED_BACK = "release-rolled-back"
BUILD_FAILED = "build-failed"
FORGOTTEN = "dataflow-forgotten"
GIVEN_UP, NOTICE_SENT, NOTICE_FAILED = "node-given-up", "notice-sent", "notice-failed"
BUNDLE_WRITTEN, BUNDLE_REFUSED = "bundle-written", "bundle-refused"
NOTICE_ENDS = (NOTICE_SENT, NOTICE_FAILED, BUNDLE_WRITTEN, BUNDLE_REFUSED)
"""What follows a failure. With DORA_UNTIL it names the newest failure that it is about."""
REQUESTS = (STOP_ASKED, "release-committed", ROLLED_BACK, BUILD_FAILED)
"""What doractl writes about a dataflow, outside of its unit."""

# Details for the text only: the origin of the record has the fields for them.
_TEXT_ONLY = ("dataflow", "node")


class _Unnamed(dict[str, object]):
    def __missing__(self, key: str) -> str:
        return f"({key} unknown)"


def event_fields(name: str, **details: Value) -> dict[str, Value]:
    """The journal fields of event `name`; the caller adds those of the origin.

    Each detail becomes DORA_<DETAIL>, except `dataflow` and `node`, which only complete the text.
    `removed` names a node that has no origin any more, for the text and DORA_NODE. The text ends
    with `exit` (such as "exit code 1") and `reason`. Raises KeyError for an unknown event.
    """
    kind = EVENTS[name]
    removed = details.pop("removed", "")
    text = kind.text.format_map(_Unnamed({**details, "node": removed} if removed else details))
    ending = [str(details[key]) for key in ("exit", "reason") if details.get(key)]
    fields: dict[str, Value] = {
        "MESSAGE": ": ".join([text, *ending]),
        "MESSAGE_ID": kind.message_id,
        "PRIORITY": kind.priority,
        "DORA_EVENT": name,
    }
    own = {
        legal_name(key, "DORA_"): value for key, value in details.items() if key not in _TEXT_ONLY
    }
    return {**own, **fields, **({"DORA_NODE": removed} if removed else {})}
