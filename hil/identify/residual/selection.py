"""Does a network for what physics leaves help? Whole trajectories it has not seen say so.

A network that does not lower the error of a joint there is dropped for that joint: what physics
leaves of it is noise, or nothing that other motions share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Which joints keep their network, and the errors that decided it.

    Attributes:
        kept: (n,) true where predictions are corrected.
        without, corrected: (n,) RMSE on left-out rows without and with the network, in effort
            units.
        better: (n,) share of the left-out trajectories on which it helps.
        margin: Share by which it had to lower the error.
    """

    kept: BoolArray
    without: FloatArray
    corrected: FloatArray
    better: FloatArray
    margin: float

    def facts(self, joint_names: Sequence[str]) -> list[dict[str, Any]]:
        """One entry per joint, for `model.json`."""
        return [
            {
                "joint": name,
                "kept": bool(self.kept[j]),
                "without": float(self.without[j]),
                "with": float(self.corrected[j]),
                "better_on": float(self.better[j]),
            }
            for j, name in enumerate(joint_names)
        ]

    @staticmethod
    def from_facts(facts: Sequence[Mapping[str, Any]], margin: float) -> Selection:
        """Inverse of `facts`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or no number.
        """
        without, corrected, better = (
            np.array([float(one[key]) for one in facts]) for key in ("without", "with", "better_on")
        )
        kept = np.array([bool(one["kept"]) for one in facts])
        return Selection(kept, without, corrected, better, margin)

    def notes(self, joint_names: Sequence[str], unit: str) -> tuple[str, ...]:
        """What people should know: where the network was dropped, and what it is worth."""
        told = []
        for word, chosen in (("kept", self.kept), ("dropped", ~self.kept)):
            if np.any(chosen):
                joints = ", ".join(self._joint(int(j), joint_names) for j in np.flatnonzero(chosen))
                told.append(
                    f"residual network {word} for {joints} {unit} on left-out trajectories"
                    + ("" if word == "kept" else f"; at least {100 * self.margin:g} % was asked")
                )
        return tuple(told)

    def _joint(self, j: int, names: Sequence[str]) -> str:
        return f"{names[j]} ({self.without[j]:.3g} → {self.corrected[j]:.3g})"


def select(
    without: FloatArray, corrected: FloatArray, blocks: IntArray, margin: float
) -> Selection:
    """Keep a joint's network if it lowers the error on rows it has not learned from.

    It has to lower it by `margin` over all of them, and on more than half of the trajectories:
    one that gains much on a single motion and loses on the others has not learned the joint.

    Args:
        without: (N, n) errors of physics alone, by models that had not seen these rows.
        corrected: (N, n) with the network, likewise.
        blocks: (N,) number of the trajectory of every row.
        margin: Share of the error, from 0.
    """
    before, after = _root_mean_square(without), _root_mean_square(corrected)
    gains = [
        _root_mean_square(corrected[blocks == b]) < _root_mean_square(without[blocks == b])
        for b in np.unique(blocks)
    ]
    better = np.mean(gains, axis=0)
    kept = (after < (1.0 - margin) * before) & (better > 0.5)
    return Selection(kept, before, after, better, margin)


def _root_mean_square(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
