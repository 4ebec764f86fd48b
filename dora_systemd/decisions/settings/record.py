"""The setting of the recorder, see dora_systemd.decisions.recorder.record."""

from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.decisions.recorder.record import (
    Record,
    check_record,
    format_record,
    parse_record,
    record_of,
)
from dora_systemd.decisions.settings.kinds import Base, Kind, Scalar, Setting, texts_of
from dora_systemd.values import scalar_text


def _parse(value: Any, _: Base) -> Record | None:
    if not isinstance(value, Mapping):
        return parse_record(scalar_text(value))
    texts = {key: scalar_text(one) for key, one in value.items() if key != "outputs"}
    return record_of(texts, texts_of(value.get("outputs", ())))


def _check(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    check_record(options.of_dataflow(RECORD.name), options, nodes)


RECORD = Setting[Record | None](
    "record",
    Kind[Record | None](
        Scalar | dict[str, Scalar | list[str]],
        "{last: 30s, memory: 200M, outputs: [NODE/OUTPUT, ...]}, yes or no",
        _parse,
        lambda record: [format_record(record)],
        metavar="last=TIME,memory=SIZE,...",
    ),
    None,
    "Keep the last messages of the outputs in memory, for a file after a failure.",
    on_members=False,
    check=_check,
)
RECORD_SETTINGS: tuple[Setting[Any], ...] = (RECORD,)
RUNNER_SETTINGS = {RECORD.name: RECORD}
