"""Execution of plans: run state machine, interlocks, preflight, live view and observers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
