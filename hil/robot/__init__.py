"""The robot protocol: what drivers implement and the engine uses.

`protocol` is the contract, `state` the rows that drivers give, `lease` the right of one process to
drive a robot. A driver may live in a process of its own: `subprocess_robot` and `subprocess_server`
are the two sides of it, `ipc` the messages between them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
