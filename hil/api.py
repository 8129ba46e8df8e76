"""The Python API: what the command line does with experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

Every function is in `hil` as well. `api.pyi` says which package implements it; it is imported when
it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("hil", __file__)
