"""Datasets of aligned samples, and pure functions of them: no file is read here.

Run directories and files of other tools become datasets in `hil.importers`, which estimators never
import (docs/explanation/architecture.md).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
