"""Advised settings.

`evidence.py` collects from the events of all lives what each node has used and how it ended.
`rules.py` compares that with the settings: one rule for each. `report.py` prints it.
"""
