"""Robot protocol: the interface that drivers implement and the engine uses.

The module `protocol` defines the interface, `state` the rows that drivers deliver, and `lease` the
exclusive access of one process to a robot. A driver can run in a separate process:
`subprocess_robot` and `subprocess_server` are the two sides of the connection, and `ipc` defines
the messages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
