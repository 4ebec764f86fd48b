"""Draws the box that was found as one line of text."""

from dora import Node

COLUMNS = 64


def line(box: list[int]) -> str:
    """A bar with the box in its place."""
    if not box:
        return "." * COLUMNS
    left, _top, width, _height = box
    return "." * left + "#" * width + "." * (COLUMNS - left - width)


def main() -> None:
    node = Node()
    for event in node:
        if event["type"] == "INPUT" and event["metadata"]["frame"] % 10 == 0:
            frame = event["metadata"]["frame"]
            print(f"frame {frame:5} {line(event['value'].to_pylist())}")


if __name__ == "__main__":
    main()
