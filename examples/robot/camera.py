"""Sends a picture for every tick: a bright square on black that moves from left to right."""

import numpy as np
import pyarrow as pa
from dora import Node

WIDTH, HEIGHT, SIZE = 64, 48, 8


def picture(frame: int) -> np.ndarray:
    """Frame number `frame` as HEIGHT rows of WIDTH grey values."""
    image = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    left = frame % (WIDTH - SIZE)
    image[20 : 20 + SIZE, left : left + SIZE] = 255
    return image


def main() -> None:
    node = Node()
    frame = 0
    for event in node:
        if event["type"] != "INPUT":
            continue
        shape = {"frame": frame, "width": WIDTH, "height": HEIGHT}
        node.send_output("image", pa.array(picture(frame).ravel()), shape)
        if frame % 10 == 0:
            print(f"frame {frame}")
        frame += 1


if __name__ == "__main__":
    main()
