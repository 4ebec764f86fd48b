"""The store of releases on disk.

`draft.py` writes a release and publishes it by a rename.
"""
