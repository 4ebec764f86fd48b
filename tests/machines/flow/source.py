"""Counts."""

import pyarrow as pa
from dora import Node

node, count = Node(), 0
for event in node:
    if event["type"] == "INPUT":
        node.send_output("number", pa.array([count]))
        count += 1
