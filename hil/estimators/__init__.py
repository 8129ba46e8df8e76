"""Estimators: robot models from data. They see datasets and dynamics, never a robot or a file.

Nothing heavy is imported before an estimator is asked for by name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.estimators.base import RobotEstimator, estimator
    from hil.estimators.model_file import load_model_file, save_model

__all__ = ["RobotEstimator", "estimator", "load_model_file", "save_model"]

_HOMES = {
    "RobotEstimator": "hil.estimators.base",
    "estimator": "hil.estimators.base",
    "load_model_file": "hil.estimators.model_file",
    "save_model": "hil.estimators.model_file",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'hil.estimators' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
