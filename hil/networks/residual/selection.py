"""Does a network for what physics leaves help? Whole trajectories it was not fitted to say so.

A network that does not lower the error of a joint there is dropped for that joint: what physics
leaves of it is noise, or nothing that other motions share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray

SURE = 0.9
"""Share of such choices in which the mean over all trajectories does gain."""

TINY = 1e-300


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

    def notes(
        self, joint_names: Sequence[str], unit: str, rows: str = "left-out trajectories"
    ) -> tuple[str, ...]:
        """What people should know: where the network was dropped, and what it is worth.

        Args:
            joint_names: n of them.
            unit: Of the errors.
            rows: What they are of.
        """
        told = []
        for word, chosen in (("kept", self.kept), ("dropped", ~self.kept)):
            if np.any(chosen):
                joints = ", ".join(self._joint(int(j), joint_names) for j in np.flatnonzero(chosen))
                told.append(
                    f"residual network {word} for {joints} {unit} on {rows}"
                    + (
                        ""
                        if word == "kept"
                        else f"; at least {100 * self.margin:g} % was asked, on nearly all of them"
                    )
                )
        return tuple(told)

    def _joint(self, j: int, names: Sequence[str]) -> str:
        return f"{names[j]} ({self.without[j]:.3g} → {self.corrected[j]:.3g})"


def select(
    without: FloatArray, corrected: FloatArray, blocks: IntArray, margin: float
) -> Selection:
    """Keep a joint's network if it lowers the error on rows it has not learned from.

    It has to lower it by `margin` over all of them, and so evenly that other trajectories can be
    expected to gain: the upper end of the one-sided 90 % interval of the mean logarithm of the
    ratio per trajectory (Student's t) is below 0. One trajectory says nothing of others, so it
    keeps none. With a margin of 0 nobody asks how sure it is.

    Args:
        without: (N, n) errors of physics alone, by models that had not seen these rows.
        corrected: (N, n) with the network, likewise.
        blocks: (N,) number of the trajectory of every row.
        margin: Share of the error, from 0.
    """
    before, after = _root_mean_square(without), _root_mean_square(corrected)
    gains = np.array(
        [_log_ratio(corrected[blocks == b], without[blocks == b]) for b in np.unique(blocks)]
    )
    kept = after < (1.0 - margin) * before
    if margin > 0.0:
        kept &= _highest_mean(gains) < 0.0
    return Selection(kept, before, after, np.mean(gains < 0.0, axis=0), margin)


def _log_ratio(corrected: FloatArray, without: FloatArray) -> FloatArray:
    after, before = (np.maximum(_root_mean_square(e), TINY) for e in (corrected, without))
    return np.asarray(np.log(after / before))


def _highest_mean(gains: FloatArray) -> FloatArray:
    """(n,) upper end of the interval of the mean of (B, n); infinite for a single one."""
    from scipy.stats import t

    count = len(gains)
    if count < 2:
        return np.full(gains.shape[1], np.inf)
    error = np.std(gains, axis=0, ddof=1) / np.sqrt(count)
    return np.asarray(np.mean(gains, axis=0) + t.ppf(SURE, count - 1) * error)


def _root_mean_square(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
