"""Figures to JSON that may stand inside a script element."""

from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np

from hil.core import json_text


def figure_json(figure: dict[str, Any]) -> str:
    """JSON of a figure with arrays as base64 of float32, which plotly.js reads natively.

    Seven significant digits are more than a plot shows and less than half the size of text. `<`,
    `>` and `&` are escaped, so no text inside can end the script element it stands in.
    """
    text = json_text(_plain(figure), separators=(",", ":"), allow_nan=False)
    return text.translate(_HTML_SAFE)


_HTML_SAFE = str.maketrans(
    {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _array(values: np.ndarray[Any, Any]) -> dict[str, str]:
    packed = np.ascontiguousarray(values, dtype="<f4")
    out = {"dtype": "f4", "bdata": base64.b64encode(packed.tobytes()).decode("ascii")}
    if packed.ndim > 1:
        out["shape"] = ", ".join(str(n) for n in packed.shape)
    return out
