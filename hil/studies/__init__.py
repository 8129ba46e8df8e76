"""Studies: evaluations that compare methods and protocols on the data of one run.

One study, for example, computes the tables and figures of a paper. A study depends on data,
dynamics and estimators, but not on a robot or a recorder. The result of a study consists of plain
tables and curves. `hil.report` draws the tables and curves of a study in the HTML page of the run,
and exports them as files for papers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
