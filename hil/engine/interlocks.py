"""Interlocks: judged on every state sample, in blocks, by level and not by edge.

An interlock says how much of its limit a block uses up; at 1 it trips. New kinds register under
the entry-point group `hil.interlocks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from hil.errors import InterlockTripped
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

    def error(self, joint_names: Sequence[str]) -> InterlockTripped:
        """The trip as the error that ends the run."""
        return InterlockTripped(
            f"interlock {self.interlock}: {joint_names[self.joint]} at "
            f"{self.value:.4g} {self.unit}, limit {self.limit:.4g} {self.unit}, "
            f"device time {self.device_time:.3f} s",
            hint="find the cause before running again; the data up to the trip is kept",
        )


class Interlock(Protocol):
    """One condition that must hold for every sample."""

    @property
    def name(self) -> str:
        """Shown when it trips."""

    def check(self, block: StructArray) -> Trip | None:
        """The first violation in the block, or None."""


@dataclass(frozen=True, slots=True)
class Threshold:
    """Trips when |value| of a joint exceeds `limit`; NaN (not measured) never trips."""

    name: str
    field: str
    limit: float
    unit: str
    scale: float = 1.0
    minus: str = ""

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        values: FloatArray = block[self.field]
        if self.minus:
            values = values - block[self.minus]
        magnitude = np.abs(values)
        if not (magnitude > self.limit).any():
            return None
        row, joint = np.argwhere(magnitude > self.limit)[0]
        return Trip(
            self.name,
            int(joint),
            float(magnitude[row, joint] * self.scale),
            self.limit * self.scale,
            self.unit,
            float(block["device_time"][row]),
        )


@dataclass(frozen=True, slots=True)
class FaultBit:
    """Trips when the controller raises its fault bit without raising an error itself."""

    name: str = "fault"

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        faulty = (block["status"] & Status.FAULT) != 0
        if not faulty.any():
            return None
        row = int(np.argmax(faulty))
        code = float(block["fault_code"][row])
        return Trip(self.name, 0, code, 0.0, "(fault code)", float(block["device_time"][row]))


def from_spec(specs: Sequence[Any]) -> list[Interlock]:
    """The interlocks a spec asks for, and the controller's fault bit, which is always watched.

    Args:
        specs: `ExperimentSpec.interlocks`.
    """
    degrees = 180 / np.pi
    out: list[Interlock] = [FaultBit()]
    for spec in specs:
        if spec.kind == "tracking_error":
            out.append(Threshold(spec.kind, "q", spec.limit_rad, "rad", minus="q_target"))
        elif spec.kind == "temperature":
            out.append(Threshold(spec.kind, "temperature", spec.limit_c, "°C"))
        elif spec.kind == "speed":
            out.append(Threshold(spec.kind, "qd", spec.limit_deg_s / degrees, "°/s", degrees))
    return out
