"""What doractl does: a file for each verb, a folder for a large one.

A verb on one node (`doractl node`, `top`, the page, dora's protocol, `doractl dora NAME -- node`)
ends in `order_node()` of `node.py`, which sends the runner a request with the caller and the door.
The runner records the event `node-asked` before it acts, and marks the node in the live table.
Whatever counts, shows or judges an end checks that table for such a request.
"""
