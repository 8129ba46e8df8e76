"""Interlocks: judged on every state sample, in blocks, by level and not by edge.

A quantity the interlock needs and the robot does not deliver while it moves trips too: what
cannot be seen is not safe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from hil.errors import InterlockTripped, PlanError
from hil.robot import Status
from hil.typing import FloatArray, StructArray


@dataclass(frozen=True, slots=True)
class Trip:
    """Why motion was stopped."""

    interlock: str
    joint: int
    value: float
    limit: float
    unit: str
    device_time: float

    def text(self, joint_names: Sequence[str]) -> str:
        """The trip in words."""
        return (
            f"interlock {self.interlock}: {joint_names[self.joint]} at "
            f"{self.value:.4g} {self.unit}, limit {self.limit:.4g} {self.unit}, "
            f"device time {self.device_time:.3f} s"
        )

    def error(self, joint_names: Sequence[str]) -> InterlockTripped:
        """The trip as the error that ends the run."""
        return InterlockTripped(
            self.text(joint_names),
            hint="find the cause before running again; the data up to the trip is kept",
        )


class Interlock(Protocol):
    """One condition that must hold for every sample."""

    @property
    def name(self) -> str:
        """Shown when it trips."""

    @property
    def action(self) -> Literal["pause", "stop"]:
        """What happens then."""

    def check(self, block: StructArray) -> Trip | None:
        """The first violation in the block, or None."""

    def clear(self, block: StructArray) -> bool:
        """Whether every row is well inside the limit again; asked while the run is paused."""


@dataclass(frozen=True, slots=True)
class Threshold:
    """Trips when |value| of a joint exceeds `limit`.

    Attributes:
        name: Shown when it trips.
        field: Field of the state record; `minus` is subtracted from it when given.
        limit: In the unit of the record.
        unit, scale: For people: `limit * scale` is in `unit`.
        required: Whether NaN (not measured) trips while the arm moves.
    """

    name: str
    field: str
    limit: float
    unit: str
    scale: float = 1.0
    minus: str = ""
    required: bool = True
    action: Literal["pause", "stop"] = "stop"

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return self.check(block) is None

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        values: FloatArray = block[self.field]
        if self.minus:
            values = values - block[self.minus]
        magnitude = np.abs(values)
        bad = magnitude > self.limit
        if self.required:
            moving = (block["status"] & Status.MOVING) != 0
            bad |= np.isnan(magnitude) & moving[:, None]
        if not bad.any():
            return None
        row, joint = np.argwhere(bad)[0]
        return Trip(
            self.name,
            int(joint),
            float(magnitude[row, joint] * self.scale),
            self.limit * self.scale,
            self.unit,
            float(block["device_time"][row]),
        )


def from_spec(specs: Sequence[Any]) -> list[Interlock]:
    """The interlocks a spec asks for.

    Args:
        specs: `ExperimentSpec.interlocks`.

    Raises:
        PlanError: There is no such kind; an interlock nobody judges would be worse than none.
    """
    return [_interlock(spec) for spec in specs]


def _interlock(spec: Any) -> Interlock:
    degrees = 180 / np.pi
    if spec.kind == "tracking_error":
        return Threshold(spec.kind, "q", spec.limit_rad, "rad", minus="q_target")
    if spec.kind == "temperature":
        # Not every arm measures temperatures; one that does not cannot be stopped by them.
        return Threshold(spec.kind, "temperature", spec.limit_c, "°C", required=False)
    if spec.kind == "speed":
        return Threshold(spec.kind, "qd", spec.limit_deg_s / degrees, "°/s", degrees)
    raise PlanError(f"there is no interlock of kind {spec.kind!r}")
