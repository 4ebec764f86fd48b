"""Passes numbers on, and says where."""

import os

from dora import Node

node = Node()
print("on", os.uname().nodename, flush=True)
for event in node:
    if event["type"] == "INPUT":
        node.send_output("number", event["value"])
