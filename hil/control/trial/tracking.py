"""A trajectory followed by a PD controller and what a law gives ahead of any error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.control.trial.arm import Arm
from hil.control.trial.gains import Spring
from hil.control.trial.reference import Reference
from hil.core import FloatArray

MOST_ERROR_RAD = 0.35
"""Further from the trajectory the arm is braked."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One run.

    Attributes:
        law: What was given ahead.
        t: (N,) time [s]; up to where the arm was braked, if it was.
        error: (N, n) position wanted minus position [rad].
        stopped: Why the arm was braked; empty when it went to the end.
    """

    law: str
    t: FloatArray
    error: FloatArray
    stopped: str = ""

    @property
    def rms(self) -> FloatArray:
        """(n,) of the error [rad]; NaN where the arm was braked."""
        return self._judged(np.sqrt(np.mean(self.error**2, axis=0)))

    @property
    def worst(self) -> FloatArray:
        """(n,) largest error [rad]; NaN where the arm was braked."""
        return self._judged(np.abs(self.error).max(axis=0))

    def _judged(self, values: FloatArray) -> FloatArray:
        return np.full_like(values, np.nan) if self.stopped else values


def track(arm: Arm, law: str, ahead: FloatArray, reference: Reference, pd: Spring) -> Tracked:
    """Follow a reference; the rest before it does not count.

    Args:
        arm: At rest at the beginning of the reference.
        law: Name of the law.
        ahead: (N, n) its torque [N·m].
        reference: N samples.
        pd: The controller.
    """
    errors, stopped = [], ""
    for q, qd, torque in zip(reference.q, reference.qd, ahead, strict=True):
        if not arm.step(torque + pd.torque(q - arm.q, qd - arm.qd)):
            stopped = "too fast, or a fault"
            break
        errors.append(q - arm.q)
        if np.abs(errors[-1]).max() > MOST_ERROR_RAD:
            joint = int(np.abs(errors[-1]).argmax())
            stopped = f"J{joint + 1} was {np.degrees(MOST_ERROR_RAD):.0f}° off"
            arm.brake()
            break
    counted = reference.t[: len(errors)] > 0
    t, error = reference.t[: len(errors)], np.array(errors).reshape(-1, reference.q.shape[1])
    if stopped:
        return Tracked(law, t, error, f"{stopped} at {reference.t[len(errors) - 1]:.2f} s")
    return Tracked(law, t[counted], error[counted])
