"""Array types used in signatures; docstrings state the shapes as (N, n) etc."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
StructArray: TypeAlias = NDArray[Any]
"""Structured array: one row per sample, with named fields."""
