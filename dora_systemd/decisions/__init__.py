"""Pure decisions: no input, no output, no clock; words and the standard library only.

Everything that can be right or wrong without a machine is here, so a unit test can try all of it.
The caller passes in the time and what it has read.
"""
