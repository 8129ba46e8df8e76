"""The pose in which an arm loads its brakes least (future work of the static paper, section V).

What counts is the root mean square of the joints' torques, each as a share of its limit. On most
arms a whole family of poses loads no brake at all; among equals the one comes first that does
least when the brakes fail, then the one with most room.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.control.brakes_fail import BrakesFail, brakes_fail
from hil.control.rest_search import (
    free_joints,
    least_effort,
    nearest_within,
    none_clear,
    starts_of,
    turned,
)
from hil.control.resting import RestingArm
from hil.core import BoolArray, FloatArray

APART_RAD = 0.5
"""Poses count as different when some joint differs by as much."""

EQUAL_SHARE = 5e-4
"""Efforts that differ by less are equal: no model knows torques better."""

NEAR_SHARE = 0.01
"""How much more effort than the least a pose near to a given one may cost."""

LEAST = "least torque"
STAYING = "least torque that stays or is held without brakes"
NEAREST = "nearest to the pose given"
ANOTHER = "another valley"

ORDER = ("stays", "held", "tips", "falls")


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """A pose, and what it asks of the brakes.

    Attributes:
        label: Why it is shown.
        q: (n,) [rad].
        torque: (n,) [N·m] that hold the arm.
        share: (n,) of the torque limits, with sign.
        effort: Root mean square of the shares.
        clearance: Smallest distance to anything [m]; infinite where none was checked.
        bodies: Between which two bodies that is.
        clear: Whether limits and clearance are kept.
        fail: What happens when the brakes fail.
    """

    label: str
    q: FloatArray
    torque: FloatArray
    share: FloatArray
    effort: float
    clearance: float
    bodies: tuple[str, str]
    clear: bool
    fail: BrakesFail

    def to_dict(self) -> dict[str, Any]:
        """As JSON; angles in degrees, distances in mm."""
        return {
            "label": self.label,
            "q_deg": np.degrees(self.q).tolist(),
            "q_rad": self.q.tolist(),
            "torque_nm": self.torque.tolist(),
            "share_percent": (100 * self.share).tolist(),
            "effort_percent": 100 * self.effort,
            "clearance_mm": 1e3 * self.clearance,
            "closest": list(self.bodies),
            "clear": self.clear,
            "brakes_fail": self.fail.to_dict(),
        }


def described(arm: RestingArm, q: FloatArray, label: str) -> RestPose:
    """What the pose `q` (n,) asks of the brakes."""
    torque = arm.gravity(q[None])[0]
    distance, bodies = arm.closest(q)
    return RestPose(
        label=label,
        q=q,
        torque=torque,
        share=torque / arm.limit,
        effort=float(arm.effort(q[None])[0]),
        clearance=distance,
        bodies=bodies,
        clear=bool(arm.is_clear(q[None])[0]),
        fail=brakes_fail(arm, q),
    )


def least_loaded(
    arm: RestingArm, *, near: FloatArray | None = None, count: int = 3, seed: int = 0
) -> tuple[RestPose, ...]:
    """Poses that load the brakes least, the best first; the same arguments give the same poses.

    First comes the least effort of all; then, unless it is the same pose, the least effort among
    poses that do not fall when the brakes fail, if there is one; then the pose nearest to `near`
    that costs hardly more than the least. What is left of `count` are other valleys.

    Args:
        arm: The arm.
        near: (n,) where it would rather be [rad].
        count: How many poses at most; one that is asked for by `near` is always among them.
        seed: Of the poses the search starts from.

    Raises:
        PlanError: No clear pose was found.
    """
    starts = starts_of(arm, seed)
    free = free_joints(arm, starts)
    wanted = np.zeros(arm.n) if near is None else near
    reached = [turned(arm, least_effort(arm, start), free, wanted) for start in starts]
    found = [described(arm, q, "") for q in reached]
    found = _distinct(sorted((pose for pose in found if pose.clear), key=_rank), free)
    if not found:
        raise none_clear(arm, starts)
    chosen = [replace(found[0], label=LEAST)]
    if staying := _first_staying(found):
        _add(chosen, staying, STAYING, free)
    if near is not None:
        chosen.append(replace(_nearest(arm, near, found), label=NEAREST))
    others = [pose for pose in found if all(_apart(pose.q, one.q, free) for one in chosen)]
    chosen += [replace(pose, label=ANOTHER) for pose in others[: max(0, count - len(chosen))]]
    return tuple(chosen)


def _rank(pose: RestPose) -> tuple[float, ...]:
    outcome = ORDER.index(pose.fail.outcome)
    return round(pose.effort / EQUAL_SHARE), outcome, -round(pose.clearance, 3), pose.effort


def _first_staying(found: Sequence[RestPose]) -> RestPose | None:
    """The best pose of the safest outcome there is, unless all of them would come down."""
    safest = min(found, key=lambda pose: (ORDER.index(pose.fail.outcome), _rank(pose)))
    return safest if safest.fail.outcome in ("stays", "held") else None


def _add(chosen: list[RestPose], pose: RestPose, label: str, free: BoolArray) -> None:
    """Add a pose, or the label alone where the pose is among those chosen already."""
    for i, other in enumerate(chosen):
        if not _apart(pose.q, other.q, free):
            chosen[i] = replace(other, label=f"{other.label}, {label}")
            return
    chosen.append(replace(pose, label=label))


def _distinct(poses: Iterable[RestPose], free: BoolArray) -> list[RestPose]:
    kept: list[RestPose] = []
    for pose in poses:
        if all(_apart(pose.q, other.q, free) for other in kept):
            kept.append(pose)
    return kept


def _apart(a: FloatArray, b: FloatArray, free: BoolArray) -> bool:
    """Whether two poses differ; whole turns and free joints do not count."""
    turn = np.remainder(a - b + np.pi, 2 * np.pi) - np.pi
    return bool(np.max(np.abs(turn[~free]), initial=0.0) > APART_RAD)


def _nearest(arm: RestingArm, near: FloatArray, found: Sequence[RestPose]) -> RestPose:
    """The pose nearest to `near` that costs at most `NEAR_SHARE` more than the least."""
    most = found[0].effort + NEAR_SHARE
    by_way = sorted(found, key=lambda pose: _far(pose.q, near))[:3]
    reached = nearest_within(arm, near, most, [near, *(pose.q for pose in by_way)])
    poses = [*found, *(described(arm, q, "") for q in reached)]
    cheap = [pose for pose in poses if pose.clear and pose.effort <= most * (1 + 1e-6)]
    return min(cheap, key=lambda pose: _far(pose.q, near))


def _far(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b))
