"""Drive gains without a known load: what a controller takes its own currents for.

A controller that computes the torque of the motion it commands (`torque_target`, from its model of
the arm) and commands a current for it (`effort_target`) knows a gain. Per joint its current is
regressed on its torque and on what it adds against friction,

    i = a·τ + b·tanh(q̇/w) + c·q̇ + d,

and the gain is 1/a. Both sides are the controller's own, so no load has to be known, nor does it
matter whether the one it was told is right; what comes out is the gain *it believes in*, of which
its maker knows more than a data sheet. On the UR10e recordings of Mamedov & Mikhel this gives
11.75 11.99 9.82 10.69 10.33 10.9 N·m/A, unloaded and with 2.8 kg alike within 0.5 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray
from hil.data import Dataset
from hil.dynamics import friction_terms
from hil.estimators.covariance import time_blocks
from hil.estimators.gain_lines import gain_lines, listed
from hil.estimators.regression import ClusteredLeastSquares

NEEDED = ("torque_target", "effort_target", "qd")

MOST_ERROR = 0.05
"""Relative standard error of a gain beyond which it is not called determined."""

LEAST_ROWS = 200

MOST_SPREAD = 0.03
"""Series whose gains differ by more than this share get a note."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerGains:
    """Torque per current of every joint as the controller has it; NaN where it does not show.

    Attributes:
        joint_names: Length n.
        gain: (n,) [N·m/A].
        gain_error: (n,) standard error, by blocks of time of the residual.
        residual_share: (n,) RMS of what the regression leaves, as a share of the current's.
        reasons: Why a joint's gain is not determined; empty where it is.
        samples: Rows used.
        declared: (n,) gains the recording declares, or None.
        notes: What else to know, for people.
    """

    method: ClassVar[str] = "controller"

    joint_names: tuple[str, ...]
    gain: FloatArray
    gain_error: FloatArray
    residual_share: FloatArray
    reasons: tuple[str, ...]
    samples: int
    declared: FloatArray | None
    notes: tuple[str, ...] = ()

    @property
    def determined(self) -> BoolArray:
        """(n,) which gains the recording tells."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil gains --json`; what is not determined is null."""
        named = zip(self.joint_names, self.reasons, strict=True)
        return {
            "method": self.method,
            "joint_names": list(self.joint_names),
            "gain_nm_a": listed(self.gain),
            "gain_error_nm_a": listed(self.gain_error),
            "residual_share": listed(self.residual_share),
            "not_determined": {name: reason for name, reason in named if reason},
            "samples": self.samples,
            "declared_nm_a": None if self.declared is None else listed(self.declared),
            "yaml": self.yaml_lines(),
            "notes": list(self.notes),
        }

    def yaml_lines(self) -> list[str]:
        """`drive_gains_nm_a` and its source; undetermined joints keep what is declared, if any."""
        source = f"the controller's current per torque over {self.samples} samples"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def shows_controller(dataset: Dataset) -> bool:
    """Whether a recording has what `controller_gains` needs."""
    return dataset.effort_kind == "current" and set(NEEDED) <= dataset.columns.keys()


def controller_gains(dataset: Dataset, sign_width: float = 0.01) -> ControllerGains:
    """Drive gains from the controller's own currents and torques.

    Args:
        dataset: With the columns `effort_target` [A], `torque_target` [N·m] and `qd`; the arm
            has to move. Loads do not matter.
        sign_width: Width of the tanh that stands for sign(qd) [rad/s].

    Raises:
        FitError: A column is missing, holds no numbers, or there are too few rows.
    """
    missing = [name for name in NEEDED if name not in dataset.columns]
    if missing or dataset.effort_kind != "current":
        what = f"lacks {', '.join(missing)}" if missing else "holds torques, no currents"
        raise FitError(
            f"the controller's gains follow from its currents and torques; the recording {what}",
            hint="import it with a map that names torque_target and effort_target, or calibrate "
            "with known loads",
        )
    data = dataset.of_kind("trajectory", "move")
    if len(data) < LEAST_ROWS or not all(np.isfinite(data[name]).all() for name in NEEDED):
        raise FitError(
            f"{len(data)} rows of motion tell no gains: at least {LEAST_ROWS} are needed, all of "
            "them with numbers",
            hint="give recordings in which every joint moves",
        )
    joints = [_of_joint(data, j, sign_width) for j in range(data.n_joints)]
    notes = _spread_notes(data, sign_width)
    return ControllerGains(
        joint_names=data.joint_names,
        gain=np.array([joint.gain for joint in joints]),
        gain_error=np.array([joint.error for joint in joints]),
        residual_share=np.array([joint.residual for joint in joints]),
        reasons=tuple(joint.reason for joint in joints),
        samples=len(data),
        declared=dataset.drive_gains,
        notes=tuple(notes),
    )


class _Joint(NamedTuple):
    gain: float = np.nan
    error: float = np.nan
    residual: float = np.nan
    reason: str = ""


def _of_joint(data: Dataset, j: int, sign_width: float) -> _Joint:
    X, current = _columns(data, j, sign_width), data["effort_target"][:, j]
    if np.ptp(X[:, 0]) == 0 or not np.any(current):
        return _Joint(reason="the controller asks for no torque or no current")
    plain = ClusteredLeastSquares(correction="CR1").fit(X, current)
    if plain.rank_ < X.shape[1]:
        return _Joint(reason="it does not move, so friction cannot be told from torque")
    residual = current - X @ plain.coef_
    blocks = time_blocks(residual[:, None], data.offsets)
    slope = plain.coef_[0]
    fitted = ClusteredLeastSquares().fit(X, current, clusters=blocks)
    gain, error = 1.0 / slope, fitted.std_error_[0] / slope**2
    share = float(np.sqrt(np.mean(residual**2) / np.mean(current**2)))
    told = f"{gain:.3g} ± {error:.2g} N·m/A"
    if slope <= 0 or not error < MOST_ERROR * gain:
        return _Joint(residual=share, reason=f"its current does not follow its torque: {told}")
    return _Joint(float(gain), float(error), share)


def _columns(data: Dataset, j: int, sign_width: float) -> FloatArray:
    friction = friction_terms(data["qd"], sign_width).values()
    return np.column_stack([data["torque_target"][:, j], *(term[:, j] for term in friction)])


def _spread_notes(data: Dataset, sign_width: float) -> Iterator[str]:
    """A note for joints whose gain depends on which series one asks."""
    if len(data.conditions) < 2:
        return
    parts = [part for i in range(len(data.conditions)) if len(part := data.take([i])) >= LEAST_ROWS]
    for j, name in enumerate(data.joint_names):
        found = [
            joint.gain for part in parts if not (joint := _of_joint(part, j, sign_width)).reason
        ]
        if len(found) > 1 and np.ptp(found) > MOST_SPREAD * np.mean(found):
            yield f"{name}: series by series {min(found):.2f} to {max(found):.2f} N·m/A"
