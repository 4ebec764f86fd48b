"""Sends a picture for every tick. A real driver would read it from the camera at its path."""

import pyarrow as pa
from dora import Node

WIDTH, HEIGHT = 64, 48


def main() -> None:
    node = Node()
    frame = 0
    for event in node:
        if event["type"] == "INPUT":
            grey = 128 - abs(frame % 256 - 128)
            picture = bytes([grey]) * (WIDTH * HEIGHT)
            node.send_output("image", pa.array(picture, type=pa.uint8()), {"frame": frame})
            frame += 1


if __name__ == "__main__":
    main()
