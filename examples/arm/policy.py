"""Decides where the arm goes: to the mean brightness of both pictures, as an angle."""

import pyarrow as pa
import pyarrow.compute as pc
from dora import Node


def main() -> None:
    node = Node()
    seen: dict[str, float] = {}
    for event in node:
        if event["type"] != "INPUT":
            continue
        seen[event["id"]] = pc.mean(event["value"]).as_py()
        if len(seen) == 2:
            node.send_output("target", pa.array([sum(seen.values()) / 2]))


if __name__ == "__main__":
    main()
