"""The first runs on a real arm: the same program slower, and only the poses nearest to the arm.

Such a run is neither fitted nor judged, so it leaves out what only serves the measurement: the
warm-up always, and with `--first` also reference visits and payload check. What remains is as
little motion as possible.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from hil.core import PlanError, SpecError
from hil.excitation import FourierSeries, Line, Motion
from hil.planning.plan import Plan, Step

MEASURED = ("dwell", "trajectory")
LEAST_SPEED = 0.01


@dataclass(frozen=True, slots=True)
class Commissioning:
    """What of a plan is executed, and how fast.

    Attributes:
        speed: Share of the limits of speed, acceleration and jerk of every move, and of the speed
            of every trajectory; paths stay the same, and what stands still stands still as long as
            before.
        first: So many poses or trajectories are measured; None for all of them.
        first_s: Measurements that are over within this estimated time; None for all [s].
        whole: Poses or trajectories of the whole plan; None when it is not known yet.
    """

    speed: float = 1.0
    first: int | None = None
    first_s: float | None = None
    whole: int | None = None

    def __str__(self) -> str:
        said = [f"at {100 * self.speed:.4g} % of the speed"] if self.speed < 1.0 else []
        said += [] if self.first is None else [f"only the first {self._counted} measured"]
        said += [] if self.first_s is None else [f"only the first {self.first_s:g} s"]
        return ", ".join(said)

    @property
    def _counted(self) -> str:
        if self.first is None or self.whole is None:
            return str(self.first)
        return f"{min(self.first, self.whole)} of {self.whole}"

    @property
    def shortened(self) -> bool:
        """Whether only a part of the program is measured."""
        return self.first is not None or self.first_s is not None

    def within(self, plan: Plan) -> Commissioning:
        """Return the same with the size of the program that `plan` is a part of."""
        return replace(self, whole=plan.whole)

    @staticmethod
    def from_dict(raw: Mapping[str, Any]) -> Commissioning:
        """Return what `to_dict` has written."""
        return Commissioning(**{name: value for name, value in raw.items() if name != "text"})

    def to_dict(self) -> dict[str, Any]:
        """For the start document; `text` says it to people."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return given | {"text": str(self)}

    def of(self, plan: Plan) -> Plan:
        """Return the plan with scaled speeds, truncated after the last selected measurement.

        Raises:
            PlanError: Nothing would be measured.
        """
        whole = len({_place(step) for step in plan if step.kind in MEASURED})
        steps = tuple(_slower(step, self.speed) for step in plan.steps)
        slower = replace(plan, steps=steps, whole=whole)
        kept = steps[: self._end(slower)]
        if not any(step.kind in MEASURED for step in kept):
            raise PlanError(
                f"nothing is measured {self}",
                hint=f"the whole plan takes {slower.duration_s:.0f} s: allow more of it",
            )
        return replace(slower, steps=kept)

    def _end(self, plan: Plan) -> int:
        """Number of steps to keep: up to the last measurement that is still wanted."""
        end, passed_s = 0, 0.0
        seen: set[tuple[int, int, int]] = set()
        for step in plan.steps:
            passed_s += plan.step_duration_s(step)
            if step.kind in MEASURED:
                seen.add(_place(step))
            if self.first is not None and len(seen) > self.first:
                return end
            if self.first_s is not None and passed_s > self.first_s:
                return end
            end = step.index + 1 if step.measures else end
        return len(plan.steps)


def commissioning_of(speed: str = "", first: str = "") -> Commissioning | None:
    """What `--speed` and `--first` say; None when they say nothing.

    Args:
        speed: `10%` or `0.1`.
        first: `10` poses or trajectories, or `30s`.

    Raises:
        SpecError: One of them cannot be.
    """
    if not speed and not first:
        return None
    share = _number(speed.removesuffix("%")) / (100.0 if speed.endswith("%") else 1.0)
    if speed and not LEAST_SPEED <= share <= 1.0:
        raise SpecError(f"--speed {speed} cannot be", hint="give a share from 1% to 100%")
    seconds = re.fullmatch(r"(.+?) ?s", first.strip())
    number = _number(seconds[1] if seconds else first)
    if first and not (number > 0 and (seconds or number == int(number))):
        raise SpecError(
            f"--first {first} cannot be",
            hint="give a number of poses or trajectories, such as 10, or a time, such as 30s",
        )
    return Commissioning(
        speed=share if speed else 1.0,
        first=int(number) if first and not seconds else None,
        first_s=number if seconds else None,
    )


def _number(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        return -1.0
    return number if math.isfinite(number) else -1.0


def _place(step: Step) -> tuple[int, int, int]:
    """What is measured: a dwell from either side is one and the same pose."""
    return step.load, step.pose, step.trajectory


def _slower(step: Step, share: float) -> Step:
    return step if step.motion is None else replace(step, motion=_motion(step.motion, share))


def _motion(motion: Motion, share: float) -> Motion:
    """Return the same path at `share` of the speed.

    Lines keep their path at any limits. With all limits scaled alike, starting and stopping take
    as long as at full speed: slower acceleration would make short moves a crawl.
    """
    if isinstance(motion, Line):
        return replace(
            motion,
            velocity=motion.velocity * share,
            acceleration=motion.acceleration * share,
            jerk=motion.jerk * share,
        )
    if isinstance(motion, FourierSeries):
        a, b = (tuple(tuple(c * share for c in row) for row in m) for m in (motion.a, motion.b))
        return replace(motion, a=a, b=b, fundamental_hz=motion.fundamental_hz * share)
    return motion
