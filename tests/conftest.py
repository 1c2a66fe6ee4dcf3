"""Settings of every test: hypothesis measures no time, since what is true of a fast machine is true of a busy one."""

from hypothesis import settings

settings.register_profile("untimed", settings(deadline=None))
settings.load_profile("untimed")
