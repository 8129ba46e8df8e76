"""Aligned arrays with units and conditions.

Importing `hil.data` pulls in no recorder: reading run directories lives in `hil.importers.load`,
which only the callers above the identification import (docs/explanation/architecture.md).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
