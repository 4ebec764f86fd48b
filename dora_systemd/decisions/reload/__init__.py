"""Hot reload: changed files become the steps of a change.

`watch_rules.py` decides whether a change of a file causes a reload, `imports.py` which programs
contain the file, `changes.py` which nodes the file affects, how two descriptors differ, and the
order of the steps.
"""
