"""What is said of drawn friction: what to read off a line, and means at rest in figures."""

from __future__ import annotations

import numpy as np

from hil.estimators import OFFSET, STATIC, VISCOUS
from hil.report import colours
from hil.report.friction_seen import AtRest, InMotion, Law
from hil.report.words import number

SIDES = (
    (1, "from below", colours.UP, "triangle-up"),
    (-1, "from above", colours.DOWN, "triangle-down"),
)


def lead(seen: InMotion) -> str:
    """What points and line of friction over velocity are."""
    told = (
        "Points are the measured effort of the held-out trajectories less what the model takes "
        "for gravity, inertia and load: friction, and what the model errs by. "
    )
    if seen.learned:
        told += (
            "What the model's network adds to its physics counts as friction on both sides, though "
            "it may be something else that the physics misses. "
        )
    if seen.law is None:
        return told + (
            "The line is the mean of the model's friction at each velocity over these "
            "trajectories, the dotted ones a standard deviation to either side."
        )
    return told + _meaning(seen.law)


def _meaning(law: Law) -> str:
    """What to read off the line, of the terms it has."""
    first = "static friction, which falls towards Coulomb friction with speed"
    found = [f"half its step at zero is {first if STATIC in law.terms else 'Coulomb friction'}"]
    if OFFSET in law.terms:
        found.append("the middle of the step is the offset")
    if VISCOUS in law.terms:
        found.append("what lies beyond the dashed line is viscous friction")
    told = (
        "The line is the model's friction, no further than these trajectories go: "
        f"{'; '.join(found)}. "
    )
    if np.isfinite(law.std_error).all(axis=0).any():
        return told + (
            "The standard errors of its parts are added up, as if all erred to the same side: the "
            "band is at most that wide."
        )
    return told + "The model has no standard errors that hold of this line: no band is drawn."


def sides(seen: AtRest, j: int, unit: str) -> str:
    """Mean friction of one joint at rest from either side, of dwells the model holds for."""
    told = []
    for sign, name, _, _ in SIDES:
        rows = (seen.approach == sign) & np.isfinite(seen.measured[:, j])
        if rows.any():
            text = f"{name} {number(float(seen.measured[rows, j].mean()))} {unit}"
            if seen.predicted is not None:
                text += f" (model {number(float(seen.predicted[rows, j].mean()))})"
            told.append(text)
    return f"mean {', '.join(told) or 'unknown'}"
