"""The dashboard: stations, live runs, catalogue, models and schedules in a browser (extra `web`).

Every page is a view of the disk; what a person asks of a run goes the way `hil stop` goes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
