"""Preview of a plan before any motion (`hil plan SPEC --json`), with warnings.

The preview also warns about settings that are allowed but probably unintended.
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
"""Ratio of the size of the finished recording to the size of its state rows.

The size ratio includes message headers, index and JointStates. The size ratio was measured on
47,000 rows of a dwell program with sensor noise (zstd chunks of 1 MiB).
"""

BYTES_PER_STEP = 500
"""Size of one step in the copy of the plan that is attached to the recording [bytes]."""


@dataclass(frozen=True, slots=True)
class PlanPreview:
    """Preview of a plan, in the form of the output of `hil plan --json`.

    Attributes:
        waypoints: Number of distinct dwell poses.
        duration_s: Estimated duration of the plan [s]; the actual settling times are unknown.
        recording_bytes: Estimated size of the recording [bytes].
        margins: Smallest distance to every limit (see `hil.planning.checks`).
        condition_number: Condition number of the column-scaled base regressor on the measuring
            samples.
        hash: Hash of the plan.
        steps: Number of steps of each kind, in order of first occurrence.
        samples: Number of state rows that the run will record.
        swept: Space that the motions of the plan sweep.
        warnings: Warnings about allowed but probably unintended settings, one sentence each.
        interlocks: Descriptions of the interlocks from `Interlocks.describe`; empty if no
            interlocks were passed.
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
        """Return the JSON form of the preview."""
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
    """Return the preview of a plan.

    Args:
        plan: Plan to preview.
        interlocks: Descriptions of the interlocks that monitor the plan.
        unasked: Warnings about properties that were not read from the robot.
    """
    size = recording_bytes(plan)
    # A commissioning run is not fitted, so condition number and loads cause no warnings.
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
    return [f"no payload check: {reason}"] if reason and is_sweep(plan) else []


def _samples(plan: Plan) -> int:
    return round(plan.duration_s * plan.rate_hz)


def recording_bytes(plan: Plan) -> int:
    """Return the estimated size of the recording [bytes].

    The estimate includes the compressed state rows and the attached plan.
    """
    row = state_dtype(len(plan.joint_names)).itemsize
    return round(_samples(plan) * row * COMPRESSION) + BYTES_PER_STEP * len(plan)


HIGHEST_CONDITION = 1000.0
"""Condition number of the column-scaled regressor above which a warning is issued.

At this condition number, noise affects some parameters about a thousand times more than others.
"""

LONGEST_S = 12 * 3600.0
LARGEST_BYTES = 20e9


def concerns(condition_number: float, duration_s: float, recording_bytes: float) -> Iterator[str]:
    """Yield one sentence for each property of a plan that is allowed but probably unintended.

    Args:
        condition_number: Condition number of the base regressor, see `hil.planning.checks`;
            infinite if the samples do not determine the parameters.
        duration_s: Estimated duration [s].
        recording_bytes: Estimated size of the recording [bytes].
    """
    if math.isinf(condition_number):
        yield (
            "the motion does not determine all parameters (infinite condition number), so a fit "
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
