"""A project becomes a release: copy, build, trial, soak, commit or the way back.

`deploy` and `rollback` end in `change.py`, the one place for what may forbid a change. A child with
the user of the nodes reads the project (`trust/project.py`). `files.py` checks what arrives.
`build.py` builds in a copy that the nodes' user owns, and reads the result as the project was read.
`StartRequest.origin` keeps root from trusting a copy, which root owns, more than the original.

The release that runs is in the path of the dataflow in the unit. An empty file in a release records
that it has passed a trial, because the journal is rotated. `trial.py` writes the history under the
lock of the store. `soak.py` is the gate. A child of doractl restores the former release if doractl
is killed (`adapters/host/guard.py`); `trial.py` describes what a killed command leaves.

`send.py` packs a project once for all hosts. `receive.py` writes the project next to the releases
of its host, and calls the same `deploy()`.
"""
