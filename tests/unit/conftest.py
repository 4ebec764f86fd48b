"""What all unit tests have in common."""

from hypothesis import settings

# A busy machine is no bug: how long an example takes is not what these tests are about.
settings.register_profile("house", deadline=None)
settings.load_profile("house")
