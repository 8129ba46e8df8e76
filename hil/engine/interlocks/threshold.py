"""The interlocks that compare a measured quantity with a limit, joint by joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.engine.interlocks.interlock import Action, Trip
from hil.robot import Status
from hil.typing import FloatArray, StructArray

CLEAR_SHARE = 0.9
"""A quantity below this share of its limit is well inside again."""

PerJoint = float | FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Threshold:
    """Trips when |value| of a joint exceeds `limit`.

    Attributes:
        name: Shown when it trips.
        field: Field of the state record; `minus` is subtracted from it when given.
        limit: In the unit of the record; one number, or (n,).
        unit, scale: For people: `limit * scale` is in `unit`.
        required: Whether NaN (not measured) trips while the arm moves.
        action: What a trip does.
        resume: Below this, in the unit of the record, the quantity is well inside again; by
            default 90 % of the limit.
    """

    name: str
    field: str
    limit: PerJoint
    unit: str
    scale: PerJoint = 1.0
    minus: str = ""
    required: bool = True
    action: Action = "stop"
    resume: PerJoint | None = None

    @property
    def watches(self) -> str:
        """The limit, for people; from the lowest to the highest where joints differ."""
        limits = np.ravel(self.limit * np.asarray(self.scale))
        shown = dict.fromkeys(f"{limit:.4g}" for limit in (limits.min(), limits.max()))
        return f"{' to '.join(shown)} {self.unit}"

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        magnitude = self._magnitude(block)
        return None if self._inside(magnitude, self.limit) else self._trip(block, magnitude)

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        resume = CLEAR_SHARE * self.limit if self.resume is None else self.resume
        return self._inside(self._magnitude(block), resume)

    def _magnitude(self, block: StructArray) -> FloatArray:
        values: FloatArray = block[self.field]
        return np.abs(values - block[self.minus] if self.minus else values)

    def _inside(self, magnitude: FloatArray, limit: PerJoint) -> bool:
        """Whether nothing is beyond the limit; NaN is when it must not be missing."""
        if self.required:
            return bool((magnitude <= limit).all())
        return not (magnitude > limit).any()

    def _trip(self, block: StructArray, magnitude: FloatArray) -> Trip | None:
        bad = magnitude > self.limit
        if self.required:
            moving = (block["status"] & Status.MOVING) != 0
            bad |= np.isnan(magnitude) & moving[:, None]
        if not bad.any():
            return None
        row, joint = np.argwhere(bad)[0]
        limit, scale = (np.broadcast_to(x, magnitude.shape[1:]) for x in (self.limit, self.scale))
        return Trip(
            self.name,
            int(joint),
            float(magnitude[row, joint] * scale[joint]),
            float(limit[joint] * scale[joint]),
            self.unit,
            float(block["device_time"][row]),
        )
