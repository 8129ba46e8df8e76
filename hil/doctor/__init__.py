"""What `hil doctor` looks at on this computer, and at a station's robots; nothing here raises."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
