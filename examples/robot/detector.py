"""Finds what is bright in a picture and sends its box: left, top, width, height."""

import numpy as np
import pyarrow as pa
from dora import Node

BRIGHT = 128


def bounding_box(image: np.ndarray) -> list[int]:
    """The box around all bright points; empty for a dark picture."""
    rows, columns = np.nonzero(image > BRIGHT)
    if not len(rows):
        return []
    left, top = int(columns.min()), int(rows.min())
    return [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]


def main() -> None:
    node = Node()
    for event in node:
        if event["type"] != "INPUT":
            continue
        about = event["metadata"]
        image = event["value"].to_numpy().reshape(about["height"], about["width"])
        box = bounding_box(image)
        node.send_output("boxes", pa.array(box, type=pa.int64()), {"frame": about["frame"]})
        if not box:
            node.log("warn", f"nothing to see in frame {about['frame']}")


if __name__ == "__main__":
    main()
