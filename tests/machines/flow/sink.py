"""Says what comes."""

from dora import Node

node = Node()
for event in node:
    if event["type"] == "INPUT":
        print("got", event["value"][0].as_py(), flush=True)
