"""One self-contained HTML page per run or model, and the same summary for a terminal.

plotly and Jinja2 are imported when a page is rendered, not before.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
