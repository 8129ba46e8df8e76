"""What a plan amounts to, before anything moves: `hil plan SPEC --json`.

It also says what is allowed and still worth a second look.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hil.arms import load_arm
from hil.planning.plan import Plan, number_or_none
from hil.planning.swept_space import Swept, swept
from hil.planning.weighing import is_sweep, why_not_weighed
from hil.robot import state_dtype

COMPRESSION = 0.71
"""Bytes in the finished file per byte of state row, message headers, index and JointStates
included: measured on 47,000 rows of a dwell program with sensor noise (zstd chunks of 1 MiB)."""

BYTES_PER_STEP = 500
"""What a step takes in the recording's attached copy of the plan."""


@dataclass(frozen=True, slots=True)
class PlanPreview:
    """The contract of `hil plan --json`.

    Attributes:
        waypoints: Distinct poses that are dwelt at.
        duration_s: Estimate; dwells take as long as settling takes.
        recording_bytes: Estimated size of the recording.
        margins: Smallest distance to every limit (see `hil.planning.checks`).
        condition_number: Of the column-scaled base regressor on the measuring samples.
        hash: The plan's identity.
        steps: Number of steps of each kind, in the order in which they first occur.
        samples: State rows to be recorded.
        swept: Where the motions take the arm.
        warnings: What is allowed and still worth a second look, a sentence each.
        interlocks: What will watch, as `Interlocks.describe` puts it; empty when nobody said.
    """

    waypoints: int
    duration_s: float
    recording_bytes: int
    margins: dict[str, float]
    condition_number: float
    hash: str
    steps: dict[str, int]
    samples: int
    swept: Swept
    warnings: tuple[str, ...] = ()
    interlocks: tuple[Mapping[str, str], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "waypoints": self.waypoints,
            "duration_s": self.duration_s,
            "recording_bytes": self.recording_bytes,
            "margins": dict(self.margins),
            "condition_number": number_or_none(self.condition_number),
            "hash": self.hash,
            "steps": dict(self.steps),
            "samples": self.samples,
            "swept": self.swept.to_dict(),
            "warnings": list(self.warnings),
            "interlocks": [dict(interlock) for interlock in self.interlocks],
        }


def preview(
    plan: Plan, interlocks: Iterable[Mapping[str, str]] = (), unasked: Iterable[str] = ()
) -> PlanPreview:
    """What `plan` amounts to, what will watch over it, and what nobody has asked the robot."""
    size = recording_bytes(plan)
    # A commissioning run is not fitted: its condition number and its loads are no concern.
    commissioning = plan.whole is not None
    condition = 1.0 if commissioning else plan.condition_number
    worries = [*concerns(condition, plan.duration_s, size)]
    worries += [] if commissioning else _not_weighed(plan)
    return PlanPreview(
        waypoints=plan.waypoints,
        duration_s=plan.duration_s,
        recording_bytes=size,
        margins=dict(plan.margins),
        condition_number=plan.condition_number,
        hash=plan.hash,
        steps=dict(Counter(step.kind for step in plan)),
        samples=_samples(plan),
        swept=swept(plan, load_arm(plan.robot_model)),
        warnings=(*unasked, *worries),
        interlocks=tuple(interlocks),
    )


def _not_weighed(plan: Plan) -> list[str]:
    masses = [load.payload.mass for load in plan.loads]
    reason = why_not_weighed(masses, sum(step.kind == "weigh" for step in plan))
    return [f"no load is weighed: {reason}"] if reason and is_sweep(plan) else []


def _samples(plan: Plan) -> int:
    return round(plan.duration_s * plan.rate_hz)


def recording_bytes(plan: Plan) -> int:
    """Estimated size of the recording: state rows as compressed, and the attached plan."""
    row = state_dtype(len(plan.joint_names)).itemsize
    return round(_samples(plan) * row * COMPRESSION) + BYTES_PER_STEP * len(plan)


HIGHEST_CONDITION = 1000.0
"""Of the column-scaled regressor; noise then reaches some parameters a thousandfold."""

LONGEST_S = 12 * 3600.0
LARGEST_BYTES = 20e9


def concerns(condition_number: float, duration_s: float, recording_bytes: float) -> Iterator[str]:
    """One sentence for everything about a plan that is allowed but hardly meant.

    Args:
        condition_number: See `hil.planning.checks`; infinite when parameters are not determined.
        duration_s: Estimated duration [s].
        recording_bytes: Estimated size of the recording.
    """
    if math.isinf(condition_number):
        yield (
            "the motion does not tell all parameters apart (infinite condition number): a fit "
            "will be refused; plan more poses or trajectories, or larger ranges"
        )
    elif condition_number > HIGHEST_CONDITION:
        yield (
            f"the condition number is {condition_number:.0f}, above {HIGHEST_CONDITION:.0f}: some "
            "parameters will be mostly noise; plan more poses or trajectories, or larger ranges"
        )
    if duration_s > LONGEST_S:
        yield f"the program takes {duration_s / 3600:.1f} h, more than {LONGEST_S / 3600:.0f} h"
    if recording_bytes > LARGEST_BYTES:
        yield (
            f"the recording takes about {recording_bytes / 1e9:.0f} GB, more than "
            f"{LARGEST_BYTES / 1e9:.0f} GB"
        )
