"""Settings: one declaration each for flag, key of the file and variable.

A setting is text with a key from the file to the runner, a member, `doractl set` and hot reload.
Its module reads, checks, merges and formats it.
"""
