"""Studies: whole evaluations of a run, such as a paper's tables and figures, from its data alone.

A model answers "how large is the error"; a study compares methods and protocols. It sees data,
dynamics and estimators, never a robot or a recorder, and its result is plain tables and curves:
`hil.report` draws them in the page and as files for papers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
