"""Lists, queries and retention of runs, all derived from the run directories."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
