"""What is known of a dataflow: from systemd, its live table, the cgroup and the journal.

`doractl list` sends systemd three requests, however many dataflows run: for the units, for its
cgroup and for its directories of unit files. The Description= of a unit has the UUID, so a `Cell`
exists before anybody has read ExecStart=. A Description= proves nothing: a verb that acts on a
dataflow, or shows more than the table, takes cells from `proven()` or a `Selector`, which have read
the options. The rest of a row is from the live table and the cgroup's files. `_missing` in
`reading.py` lists the properties that are requested for a single unit: those that its live table
does not contain.
"""
