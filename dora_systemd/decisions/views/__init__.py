"""What people and programs see: list, top, doctor, metrics, JSON.

`facts.py` has a row for each fact of a node, and `rows.py` for each of a dataflow: `list`, `top`,
the page, `/metrics` and JSON come from these.
"""
