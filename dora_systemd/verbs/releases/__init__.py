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

ostree(1) cannot be the store. Tried with ostree 2022.7, 500 MB in 2,100 files:

- A checkout with hard links shares its files with the repository and with all other releases. A
  program that writes into its release, as a node in user scope can, changes every release.
- All times of files become 0, so Python compiles its modules at each start.
- A commit with 1 MB changed takes 12.9 s on a busy machine, `cp -r` of everything 0.8 s.
- History, trial, build and the checks of hostile files remain: only `adapters/releases/store.py`
  would become smaller, and the package would need four more.
"""
