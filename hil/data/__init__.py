"""Aligned arrays with units and conditions.

Importing `hil.data` pulls in no recorder: reading run directories lives in `hil.importers.load`,
which only the callers above the identification import (docs/explanation/architecture.md).
"""

from hil.data.dataset import Conditions, Dataset, rows_of
from hil.data.prediction import Model, Prediction, Stream

__all__ = ["Conditions", "Dataset", "Model", "Prediction", "Stream", "rows_of"]
