"""A project becomes a release: copy, build, trial, soak, commit or the way back.

`deploy` and `rollback` end in `change.py`, the one place for what may forbid a change. A child that
is the user of the nodes reads the project (`trust/project.py`). `files.py` checks what arrives.
`build.py` builds in a copy that the nodes' user owns, and reads that as the project was read.
`StartRequest.origin` keeps root from believing a copy, which is root's, more than the original.

The release that runs is in the path of the dataflow in the unit. An empty file in a release records
that it has passed a trial, because the journal is rotated. `trial.py` writes the history under the
lock of the store. `soak.py` is the gate. A child of doractl goes back if doractl is killed
(`adapters/host/guard.py`); what a killed command leaves is in `trial.py`.

`send.py` packs a project once for all hosts. `receive.py` writes it beside the releases there, and
calls the same `deploy()`.
"""
