"""A module for each verb, in the section of `doractl --help` that lists it."""
