"""CAN on one computer: a bus between processes, what frames cost on the wire, logs of them.

Shared by drivers and mock robots; nothing in here knows CANopen. `can` is imported where used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
