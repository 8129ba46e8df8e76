"""The interlocks that compare a measured quantity with a limit, joint by joint."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, StructArray
from hil.engine.interlock_moving import moving
from hil.engine.interlock_protocol import Action, Margin, Trip

CLEAR_SHARE = 0.9
"""A quantity below this share of its limit is well inside again."""

PerJoint = float | FloatArray

_ALL = np.array(True)


@dataclass(slots=True, eq=False)
class Threshold:
    """Trips when |value| of a joint exceeds `limit`, or is missing where it must not be.

    Attributes:
        name: Shown when it trips.
        field: Field of the state record; `minus` is subtracted from it when given.
        limit: In the unit of the record; one number, or (n,).
        unit, scale: For people: `limit * scale` is in `unit`.
        required: Whether NaN (not measured) trips while the arm moves. If not, it does so only
            for joints that were measured before.
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
    _expected: BoolArray = dataclasses.field(init=False)
    _before: StructArray | None = dataclasses.field(default=None, init=False)

    def __post_init__(self) -> None:
        # Of which joints a value is to come: of all, or of those that one came of.
        self._expected = np.array(self.required)

    @property
    def watches(self) -> str:
        """The limit, for people; from the lowest to the highest where joints differ.

        A limit that is infinite is none.
        """
        limits = np.ravel(self.limit * np.asarray(self.scale))
        limits = limits[np.isfinite(limits)]
        shown = dict.fromkeys(f"{limit:.4g}" for limit in (limits.min(), limits.max()))
        return f"{' to '.join(shown)} {self.unit}"

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        if not len(block):
            return None
        before, self._before = self._before, block
        magnitude = self._magnitude(block)
        if (magnitude <= self.limit).all():
            self._expected = _ALL
            return None
        return self._trip(block, before, magnitude)

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        resume = CLEAR_SHARE * self.limit if self.resume is None else self.resume
        magnitude = self._magnitude(block)
        return not ((magnitude > resume) | self._missing(magnitude)).any()

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`: that of the joint which is nearest to its limit."""
        magnitude = self._magnitude(block[-1:])[0]
        limit, scale = (np.broadcast_to(x, magnitude.shape) for x in (self.limit, self.scale))
        used = np.where(np.isfinite(limit), magnitude / limit, np.nan)  # no limit: no margin
        if np.isnan(used).all():
            return None
        joint = int(np.nanargmax(used))
        value, most = float(magnitude[joint] * scale[joint]), float(limit[joint] * scale[joint])
        share = max(0.0, 1.0 - float(used[joint]))
        return Margin(value, most, self.unit, share, joint)

    def _magnitude(self, block: StructArray) -> FloatArray:
        values: FloatArray = block[self.field]
        return np.abs(values - block[self.minus] if self.minus else values)

    def _missing(self, magnitude: FloatArray) -> BoolArray:
        """(N, n) what is NaN although a value is to come of that joint."""
        unknown = np.isnan(magnitude)
        expected = np.logical_or.accumulate(~unknown, axis=0) | self._expected
        self._expected = expected[-1]
        missing: BoolArray = unknown & expected
        return missing

    def _trip(
        self, block: StructArray, before: StructArray | None, magnitude: FloatArray
    ) -> Trip | None:
        bad, missing = magnitude > self.limit, self._missing(magnitude)
        if missing.any():
            bad |= missing & moving(block, before)[:, None]
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
            lost=bool(missing[row, joint]) and not self.required,
        )
