"""Python API: functions of the command line for experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

Every function is also available in `hil`. `api.pyi` lists the package that implements each
function; the package is imported at the first use of the function.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("hil", __file__)
