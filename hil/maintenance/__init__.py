"""Models kept up to date: schedules, stages of a re-identification, runs of a whole fleet."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
