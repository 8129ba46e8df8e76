"""For people who test: mock robots for their tests, and the contract of a robot as checks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
