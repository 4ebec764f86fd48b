"""Releases: files, manifest, history, and which releases stay.

`past.py` reads the history, a line for each change of what runs. `parcel.py` is what travels to
another host: a line that lists the files, the answer that names the missing contents, and these.
`progress.py` has a function for each step that people see.
"""
