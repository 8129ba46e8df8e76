"""When a study of inverse dynamics may put two methods in order, and what it says when not.

Draws of the split and of the networks are paired: both methods have the same ones. Two methods of
equal error, with differences that are normal and independent from draw to draw, would be ranked
all the same in 21 % of all studies with two draws, in 7.4 % with three and in 1.1 % with five
(Student's t with one degree of freedom less, beyond `APART`·√draws).
"""

from __future__ import annotations

import numpy as np

from hil.studies.inverse_found import Found

APART = 2.0
"""Standard deviations over the seeds by which paired errors must differ for a ranking."""

FEWEST_SEEDS = 3
"""Fewer draws rank nothing."""


def apart(found: Found, a: str, b: str) -> bool:
    """Whether a and b differ by more than two seed-σ of their paired differences."""
    difference = found.by_seed(a) - found.by_seed(b)
    if len(difference) < FEWEST_SEEDS:
        return False
    return abs(float(np.mean(difference))) > APART * float(np.std(difference, ddof=1))


def doubt(found: Found) -> str:
    """Why what is not apart is not told apart."""
    seeds = len(found.seen)
    if seeds >= FEWEST_SEEDS:
        return "they differ by less than two seed-σ"
    return "one draw ranks nothing" if seeds == 1 else f"{seeds} draws rank nothing"


def beside(found: Found, key: str, reference: str, name: str) -> str:
    """How much less key leaves than the reference, and whether that can be told from chance.

    Args:
        found: What came of a protocol.
        key: Of a row.
        reference: Of another one.
        name: Of the reference, for people.
    """
    error, against = found.average(key), found.average(reference)
    if error == against:
        return f"the same as {name}"
    told = f"{_less(error, against)} than {name}"
    return told if apart(found, key, reference) else f"{told} (not told apart: {doubt(found)})"


def _less(error: float, reference: float) -> str:
    percent = 100 * (1 - error / reference)
    size = f"{abs(percent):.0f} %" if abs(percent) >= 0.5 else "under half a per cent"
    return f"{size} {'less' if percent >= 0 else 'more'}"
