"""Rows of numbers a residual network is fed, scaled by what it learned from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.networks.residual.motions import Motions
from hil.networks.residual.settings import ResidualSettings

TINY = 1e-9
"""Added to scales: a joint that never moved is divided by something."""


@dataclass(frozen=True, slots=True, eq=False)
class InputScales:
    """Means and deviations of the rows learned from, (n,) each, and the range of the inputs.

    Beyond the range it was trained in nobody knows what a network says: inputs are held at its
    ends.

    Attributes:
        q_mean, q, qd, qdd, base_mean, base, heard_mean, heard: Means, and deviations to divide by.
        lowest, highest: (G, F) of the scaled inputs.
    """

    q_mean: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    base_mean: FloatArray
    base: FloatArray
    heard_mean: FloatArray
    heard: FloatArray
    lowest: FloatArray
    highest: FloatArray

    def to_arrays(self) -> dict[str, FloatArray]:
        """By name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, FloatArray], settings: ResidualSettings, n: int
    ) -> InputScales:
        """Inverse of `to_arrays`, for n joints.

        Raises:
            DataError: An array is missing or has another shape.
        """
        shapes: dict[str, tuple[int, ...]] = {f.name: (n,) for f in fields(InputScales)}
        shapes |= dict.fromkeys(("lowest", "highest"), group_shape(settings, n))
        for name, shape in shapes.items():
            found = np.shape(arrays[name]) if name in arrays else None
            if found != shape:
                raise DataError(
                    f"the residual network's scale {name} has shape {found}, not {shape}"
                )
        return InputScales(**{name: np.asarray(arrays[name]) for name in shapes})


def group_shape(settings: ResidualSettings, n: int) -> tuple[int, int]:
    """(G, F): groups of inputs, and how many each sees."""
    heard = int(settings.inputs != "motion")
    if settings.layout == "joint":
        return 1, n * (3 + heard)
    return n, 2 + len(settings.sign_widths) + int(settings.base_input) + heard


class NetworkInputs:
    """Inputs by layout: G groups of F numbers, every joint its own or one group for all.

    Args:
        settings: Which inputs.
        scales: From `scaled_to`, or of a stored network.
    """

    def __init__(self, settings: ResidualSettings, scales: InputScales) -> None:
        self.settings = settings
        self.scales = scales

    @staticmethod
    def scaled_to(motions: Motions, rows: BoolArray, settings: ResidualSettings) -> NetworkInputs:
        """Inputs scaled by the rows (N,) to be learned from."""
        n = motions.n
        heard = motions.heard(settings)
        heard = np.zeros((len(motions), n)) if heard is None else heard
        known = heard[rows & np.all(np.isfinite(heard), axis=1)]
        known = known if len(known) else np.zeros((1, n))
        scales = InputScales(
            q_mean=motions.q[rows].mean(axis=0),
            q=motions.q[rows].std(axis=0) + TINY,
            # Velocities and accelerations keep their zero: it means rest.
            qd=_rms(motions.qd[rows]),
            qdd=_rms(motions.qdd[rows]),
            base_mean=motions.base[rows].mean(axis=0),
            base=motions.base[rows].std(axis=0) + TINY,
            heard_mean=known.mean(axis=0),
            heard=known.std(axis=0) + TINY,
            lowest=np.full((1, 1), -np.inf),
            highest=np.full((1, 1), np.inf),
        )
        inputs = NetworkInputs(settings, scales).of(motions)[rows]
        ranged = {f.name: getattr(scales, f.name) for f in fields(scales)}
        ranged |= {"lowest": inputs.min(axis=0), "highest": inputs.max(axis=0)}
        return NetworkInputs(settings, InputScales(**ranged))

    def of(self, motions: Motions) -> FloatArray:
        """(N, G, F) for every row."""
        heard = motions.heard(self.settings)
        return self.rows(motions.q, motions.qd, motions.qdd, motions.base, heard)

    def rows(
        self,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        base: FloatArray,
        heard: FloatArray | None,
    ) -> FloatArray:
        """(N, G, F) from arrays (N, n); `heard` as `Motions.heard` has it."""
        by_joint = self._grouped(qd, qdd, base) if self._own else self._joint(q, qd, qdd)
        if heard is not None:
            scaled = (heard - self.scales.heard_mean) / self.scales.heard
            # What has not arrived yet is taken for the mean.
            by_joint.append(np.where(np.isfinite(scaled), scaled, 0.0))
        # (N, n, F) as it is, or all joints' numbers one behind the other.
        stacked = np.stack(by_joint, axis=-1)
        stacked = stacked if self._own else stacked.reshape(len(q), 1, -1)
        clipped: FloatArray = np.clip(stacked, self.scales.lowest, self.scales.highest)
        return clipped

    @property
    def _own(self) -> bool:
        return self.settings.layout == "grouped"

    def _grouped(self, qd: FloatArray, qdd: FloatArray, base: FloatArray) -> list[FloatArray]:
        s = self.scales
        signs = [np.tanh(qd / width) for width in self.settings.sign_widths]
        told = [(base - s.base_mean) / s.base] if self.settings.base_input else []
        return [qd / s.qd, *signs, qdd / s.qdd, *told]

    def _joint(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> list[FloatArray]:
        s = self.scales
        return [(q - s.q_mean) / s.q, qd / s.qd, qdd / s.qdd]


def _rms(values: FloatArray) -> FloatArray:
    root: FloatArray = np.sqrt(np.mean(values**2, axis=0)) + TINY
    return root
