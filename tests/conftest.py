"""What all tests have in common."""

from hypothesis import settings

# How long an example takes depends on what else the computer does.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
