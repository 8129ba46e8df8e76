"""Checks of this computer and of a station's robots, for `hil doctor`; errors become findings."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
