"""Dashboard: stations, live runs, catalogue, models and schedules in a browser (extra `web`).

Every page shows data that are read from the disk. Requests to a run, such as Stop, reach the run in
the same manner as `hil stop`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
