"""Datasets of aligned samples, and functions of datasets; no function reads files.

The package `hil.importers` converts run directories and files of other tools into datasets.
Estimators never import `hil.importers` (docs/explanation/architecture.md).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
