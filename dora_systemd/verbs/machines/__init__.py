"""The part of a member (`doractl member`) and the verbs of `doractl machine`."""
