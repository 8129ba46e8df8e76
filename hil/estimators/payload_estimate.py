"""What a loaded recording told about its load, and how surely."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, card, number
from hil.data import Prediction
from hil.estimators.covariance import interval

NAMES = ("mass", "com_x", "com_y", "com_z", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
UNITS = ("kg", *3 * ("m",), *6 * ("kg·m²",))
KEYS = ("mass_kg", "com_m", "inertia_kgm2")
LEVEL = 0.95

MASS_SHARE = 0.05
"""A mass is well determined when its 95 % interval reaches no further than this share of it."""

COM_REACH_M = 0.01
"""A coordinate of the centre of mass is when its interval reaches no further than this."""

INERTIA_SHARE = 0.25
"""An inertia is when its interval reaches no further than this share of the largest one."""


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """By how much friction was another on the day of the load than the model has it.

    Attributes:
        offset: (n,) constant to be added [A or N·m].
        scale: (n,) share of the model's friction to be added.
    """

    offset: FloatArray
    scale: FloatArray

    def of(self, prediction: Prediction) -> FloatArray:
        """(N, n) what is to be added to a prediction."""
        zero = np.zeros_like(prediction.effort)
        friction = prediction.components.get("friction", zero) if np.any(self.scale) else zero
        added: FloatArray = self.offset + self.scale * friction
        return added


@dataclass(frozen=True, slots=True, eq=False)
class PayloadEstimate:
    """A load identified from motion.

    Values are in the order of `NAMES`: mass, centre of mass in the flange frame, inertia about the
    centre of mass along the flange's axes.

    Attributes:
        payload: The load: always one that positive masses can make. Of an arm at rest a point mass,
            coordinates that do not show being 0; nothing where no load shows.
        values: (10,) the same as numbers; NaN for what does not show at rest.
        std_error: (10,) standard errors, given the form of the model and its drive gains; at rest
            with the errors of both.
        interval: (10, 2) 95 % intervals of Student's t by blocks of time.
        covariance: (10, 10) of the values, whose diagonal `std_error` squares.
        degrees: (10,) of Student's t.
        by_gain: (10, n) by how much a value is too small for each share by which the true gain of a
            joint's drive is above the model's, had the arm's own torques been learned with it; the
            errors above know nothing of gains.
        residual: (n,) RMS of the filtered effort less the prediction with the load.
        without: (n,) the same with nothing at the flange.
        unit: `A` or `N·m`, of the residuals.
        joint_names: Length n.
        friction: What of the model's friction was freed: `model` (nothing), `offset`, `scale`; or
            `rest`, where two approaches cancel it.
        correction: By how much, zeros where it was not.
        samples: Rows used; at rest, poses.
        blocks: Blocks of time that counted as independent; at rest, poses.
        bounded: Whether the recording alone would have had a body that cannot be; the errors are
            those without that knowledge.
        gain_share: Standard deviation of a drive gain that the errors know of, as a share of it.
        other_arm: What speaks against believing it at all: the recording is of another individual
            than the model.
        notes: For people.
    """

    payload: Payload
    values: FloatArray
    std_error: FloatArray
    interval: FloatArray
    covariance: FloatArray
    degrees: FloatArray
    by_gain: FloatArray
    residual: FloatArray
    without: FloatArray
    unit: str
    joint_names: tuple[str, ...]
    friction: str
    correction: Correction
    samples: int
    blocks: int
    bounded: bool
    notes: tuple[str, ...] = ()
    gain_share: float = 0.0
    other_arm: str = ""

    def __repr__(self) -> str:
        low, high = self.interval[0]
        return f"<PayloadEstimate {self.values[0]:.3g} kg ({low:.3g} … {high:.3g})>"

    def _repr_html_(self) -> str:
        """Itself in a notebook: a row per parameter that shows."""
        rows = [
            (one["name"], number(one["value"]), number(one["std_error"]),
             " … ".join(map(number, one["interval_95"])), "yes" if one["determined"] else "no")
            for one in self.to_dict()["parameters"]
            if one["value"] is not None
        ]  # fmt: skip
        head = ("parameter", "value", "± std", "95 % interval", "well determined")
        warned = [f"Not to be relied on: {self.other_arm}"] if self.other_arm else []
        facts = {"samples": self.samples, "independent": self.blocks, "friction": self.friction}
        notes = [*warned, *self.notes]
        return card("Load", f"{self.values[0]:.3g} kg", facts, table=(head, rows), notes=notes)

    def with_gains(self, share: float) -> PayloadEstimate:
        """The same with errors that know of the gains, independent from joint to joint.

        Args:
            share: Standard deviation of a drive gain [share of it]. Torques have no gains.
        """
        gains = share if self.unit == "A" else 0.0
        covariance = self.covariance + gains**2 * self.by_gain @ self.by_gain.T
        error = np.sqrt(np.diag(covariance))
        ends = interval(self.values, error, self.degrees, LEVEL)
        return replace(
            self, covariance=covariance, std_error=error, interval=ends, gain_share=gains
        )

    @property
    def determined(self) -> dict[str, bool]:
        """Which of the ten the recording tells well, by name."""
        reach = (self.interval[:, 1] - self.interval[:, 0]) / 2
        largest = float(np.max(np.abs(self.values[4:7]), initial=0.0))
        limit = np.array(
            [MASS_SHARE * self.values[0], *3 * [COM_REACH_M], *6 * [INERTIA_SHARE * largest]]
        )
        return dict(zip(NAMES, (reach <= limit).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil payload --json`."""
        rows = zip(NAMES, UNITS, self.values, self.std_error, self.interval, strict=True)
        known = self.determined
        return {
            "payload": {
                "mass_kg": self.payload.mass,
                "com_m": _numbers(self.values[1:4]),
                "inertia_kgm2": _numbers(self.values[4:]),
            },
            "parameters": [
                {
                    "name": name, "unit": unit, "value": _number(value),
                    "std_error": _number(error), "interval_95": _numbers(ends),
                    "determined": known[name],
                }
                for name, unit, value, error, ends in rows
            ],
            "joint_names": list(self.joint_names),
            "unit": self.unit,
            "residual": [float(value) for value in self.residual],
            "residual_without_load": [float(value) for value in self.without],
            "friction": self.friction,
            "correction": {
                "offset": [float(value) for value in self.correction.offset],
                "scale": [float(value) for value in self.correction.scale],
            },
            "samples": self.samples,
            "blocks": self.blocks,
            "bounded": self.bounded,
            "gain_share": self.gain_share,
            "other_arm": self.other_arm,
            "notes": list(self.notes),
        }  # fmt: skip


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if np.isfinite(value) else None


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(value) for value in values]
