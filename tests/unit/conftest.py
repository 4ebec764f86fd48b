"""What all unit tests have in common."""

import signal

from hypothesis import settings

# A shell hands SIGINT on ignored to what it starts in the background, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no bug: how long an example takes is not what these tests are about.
settings.register_profile("house", deadline=None)
settings.load_profile("house")
