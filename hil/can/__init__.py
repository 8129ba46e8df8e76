"""CAN tools for one computer: bus between processes, length of frames on the wire, frame logs.

Drivers and mock robots use this package, which does not depend on CANopen. The package `can`
(python-can) is imported only by the modules that need it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
