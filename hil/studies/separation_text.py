"""Small words and numbers that the parts of a separation study share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil.studies.result import Value


def joint_titles(n: int) -> tuple[str, ...]:
    """J1 to Jn."""
    return tuple(f"J{j + 1}" for j in range(n))


def values(numbers: FloatArray | Sequence[float]) -> tuple[Value, ...]:
    """Numbers for a table; None where there is none."""
    return tuple(value(float(number)) for number in numbers)


def value(number: float) -> float | None:
    """A number for a table; None for NaN."""
    return number if np.isfinite(number) else None


def mean_of(per_joint: FloatArray) -> float:
    """Mean over the joints it is known for; NaN without any."""
    known = per_joint[np.isfinite(per_joint)]
    return float(np.mean(known)) if len(known) else float("nan")


def with_mean(per_joint: FloatArray) -> tuple[Value, ...]:
    """The joints, and their mean."""
    return values([*per_joint.tolist(), mean_of(per_joint)])


def listed(items: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([", ".join(items[:-1]), items[-1]] if len(items) > 1 else list(items))


def layout_name(layout: Sequence[int]) -> str:
    """`4-20-20-10-1`."""
    return "-".join(str(units) for units in layout)
