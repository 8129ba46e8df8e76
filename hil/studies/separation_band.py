"""Poses approached from both sides: their mean is gravity, half their difference stick friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.data import correlation, rmse
from hil.studies.result import Table, Value
from hil.studies.separation_data import pairs
from hil.studies.separation_honest import HonestRun
from hil.studies.separation_text import joint_titles, mean_of, value

GRAVITY = ("gravity", "gravity-paper", "wls", "ls", "ridge")
"""What stands for a model without friction: the first of them that was fitted."""

FRICTION = ("coulomb", "network-approach", "hysteresis")
"""Methods that know the approach, ours last."""

SHORT = {"coulomb": "Fc·sign", "network-approach": "network", "hysteresis": "ours"}


@dataclass(frozen=True, slots=True, eq=False)
class Sides:
    """Mean and half difference of both approaches; (P, n) each.

    Attributes:
        mean: Of the dwells from below and from above.
        half: Half of below less above.
    """

    mean: FloatArray
    half: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Measured and predicted, pose by pose.

    Attributes:
        measured: Of the recording.
        predicted: By the methods, by key; of poses they have not seen.
        common: (P, n) where both approaches are compared.
        unit: Of the effort.
    """

    measured: Sides
    predicted: dict[str, Sides]
    common: BoolArray
    unit: str

    @property
    def load(self) -> FloatArray:
        """(P, n) what the drive holds beside friction."""
        return np.abs(self.measured.mean)


def bands(run: HonestRun) -> Bands | None:
    """What poses approached from both sides tell; None when there are none."""
    conditions = [run.dwells.conditions[number] for number in run.judged_dwells]
    both = pairs(tuple(conditions))
    if not both:
        return None
    predicted = {key: _sides(one.effort, both) for key, one in run.methods.items()}
    common = np.array([run.common[below + above].all(axis=0) for below, above in both])
    return Bands(_sides(run.measured, both), predicted, common, run.dwells.effort_unit)


def band_tables(found: Bands) -> tuple[Table, ...]:
    """Gravity and friction band per joint, and how the band grows with the load."""
    return _both(found), _over_load(found)


def gravity_of(found: Bands) -> str | None:
    """The method that stands for gravity alone."""
    return next((key for key in GRAVITY if key in found.predicted), None)


def friction_of(found: Bands) -> list[str]:
    """Methods that predict a band at all."""
    return [key for key in FRICTION if key in found.predicted]


def _sides(values: FloatArray, both: list[tuple[list[int], list[int]]]) -> Sides:
    below = np.array([values[numbers].mean(axis=0) for numbers, _ in both])
    above = np.array([values[numbers].mean(axis=0) for _, numbers in both])
    return Sides((below + above) / 2, (below - above) / 2)


def _both(found: Bands) -> Table:
    gravity, friction = gravity_of(found), friction_of(found)
    means = [*([gravity] if gravity else []), *friction[-1:]]
    columns = (
        "joint",
        *(f"mean: {SHORT.get(key, 'gravity')}" for key in means),
        "band", "its spread",
        *(f"band: {SHORT[key]}" for key in friction),
        *(f"R: {SHORT[key]}" for key in friction[-1:]),
    )  # fmt: skip
    n = found.common.shape[1]
    body: list[tuple[Value, ...]] = []
    for j, title in enumerate(joint_titles(n)):
        rows = found.common[:, j]
        measured = found.measured.half[rows, j]
        body.append(
            (
                title,
                *(_error(found.measured.mean, found.predicted[k].mean, rows, j) for k in means),
                value(float(np.mean(measured))) if len(measured) else None,
                value(float(np.std(measured))) if len(measured) else None,
                *(_error(found.measured.half, found.predicted[k].half, rows, j) for k in friction),
                *(_r(found, key, rows, j) for key in friction[-1:]),
            )
        )
    return Table(
        "table-sides",
        "Both approaches of a pose: RMSE of their mean, and of half their difference, the band "
        f"[{found.unit}]",
        columns,
        tuple(body),
        f"{len(found.common)} poses. In the mean of both sides stick friction cancels; half their "
        "difference is stick friction, measured without any model. “its spread” is its standard "
        "deviation over the poses: the error of somebody who knows its mean and nothing else.",
    )


def _over_load(found: Bands) -> Table:
    friction = [key for key in friction_of(found) if key != "network-approach"]
    columns = ["joint"]
    for third in ("lightest", "heaviest"):
        columns += [f"load, {third} third", "band"]
        columns += [f"band: {SHORT[key]}" for key in friction]
    body = []
    for j, title in enumerate(joint_titles(found.common.shape[1])):
        rows = np.flatnonzero(found.common[:, j])
        ordered = rows[np.argsort(found.load[rows, j], kind="stable")]
        row: list[Value] = [title]
        for part in (ordered[: len(ordered) // 3], ordered[-(len(ordered) // 3) :]):
            sides = [found.load, found.measured.half]
            sides += [found.predicted[key].half for key in friction]
            row += [value(mean_of(values[part, j])) for values in sides]
        body.append(tuple(row))
    return Table(
        "table-load",
        "Friction band and load: means over the third of the poses with least and with most load "
        f"[{found.unit}]",
        tuple(columns),
        tuple(body),
        "Load is what the drive holds in the mean of both sides. Fc·sign(approach) has one band "
        "for all loads.",
    )


def _error(a: FloatArray, b: FloatArray, rows: BoolArray, j: int) -> float | None:
    return value(float(rmse(a[rows, j, None], b[rows, j, None])[0]))


def _r(found: Bands, key: str, rows: BoolArray, j: int) -> float | None:
    a, b = found.measured.half, found.predicted[key].half
    return value(float(correlation(a[rows, j, None], b[rows, j, None])[0]))
