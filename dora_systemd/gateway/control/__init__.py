"""dora's control protocol from the coordinator's side, at `/api/control`.

`serve.py` is a table of its requests. The gateway uses our UUIDs; each run in a cell has another
one. `forward.py` replaces them in both directions, and passes frames of topics unchanged.
"""
