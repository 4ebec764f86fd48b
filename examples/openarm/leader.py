"""Stands for the arm that a person moves: its joints swing, and its gripper counts the ticks."""

import math

import pyarrow as pa
from dora import Node


def main() -> None:
    """Send both positions at each tick."""
    node, count = Node(), 0
    for event in node:
        if event["type"] != "INPUT":
            continue
        count += 1
        joints = [math.sin(count / 250 + joint) for joint in range(7)]
        for side in ("right", "left"):
            # The count shows in a dataset whether a row is missing.
            node.send_output(f"position_{side}", pa.array([*joints, count], type=pa.float32()))


if __name__ == "__main__":
    main()
