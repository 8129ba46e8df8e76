"""Commissioning: first runs on a real arm, at reduced speed and with only the nearest poses.

A commissioning run is neither fitted nor evaluated, so it omits steps that only serve the
measurement: always the warm-up, and with `--limit` also reference visits and the payload check. The
motion of a commissioning run is as short as possible.
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
    """Part of a plan to execute, and its speed.

    Attributes:
        speed: Ratio of the executed speed to the planned speed. The ratio `speed` scales the limits
            of speed, acceleration and jerk of every move, and the speed of every trajectory. Paths
            and dwell times do not depend on this ratio.
        first: Number of poses or trajectories to measure; None for all poses or trajectories.
        first_s: Estimated time after which the plan contains no further measurement [s]; None for
            no time limit.
        whole: Number of poses or trajectories of the whole plan; None if the number is not known
            yet.
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
        """Return a copy that also contains the size of the program of which `plan` is a part."""
        return replace(self, whole=plan.whole)

    @staticmethod
    def from_dict(raw: Mapping[str, Any]) -> Commissioning:
        """Return the commissioning data from a dictionary created by `to_dict`."""
        return Commissioning(**{name: value for name, value in raw.items() if name != "text"})

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the start document; its key `text` is a readable description."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return given | {"text": str(self)}

    def of(self, plan: Plan) -> Plan:
        """Return the plan with scaled speeds, truncated after the last selected measurement.

        Raises:
            PlanError: The selected part contains no measurement.
        """
        whole = len({_place(step) for step in plan if step.kind in MEASURED})
        steps = tuple(_slower(step, self.speed) for step in plan.steps)
        slower = replace(plan, steps=steps, whole=whole)
        kept = steps[: self._end(slower)]
        if not any(step.kind in MEASURED for step in kept):
            raise PlanError(
                f"nothing would be measured: {self}",
                hint=f"increase --limit; the whole plan takes {slower.duration_s:.0f} s",
            )
        return replace(slower, steps=kept)

    def _end(self, plan: Plan) -> int:
        """Return the number of steps to retain, up to the last selected measurement."""
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
    """Return the commissioning data for `--speed-scale` and `--limit`; None if both are empty.

    Args:
        speed: Ratio of executed speed to planned speed, as text such as `10%` or `0.1`.
        first: Number of poses or trajectories, such as `10`, or a duration, such as `30s`.

    Raises:
        SpecError: The text for speed or limit is invalid.
    """
    if not speed and not first:
        return None
    share = _number(speed.removesuffix("%")) / (100.0 if speed.endswith("%") else 1.0)
    if speed and not LEAST_SPEED <= share <= 1.0:
        raise SpecError(
            f"--speed-scale {speed} is not a valid share", hint="pass a share from 1% to 100%"
        )
    seconds = re.fullmatch(r"(.+?) ?s", first.strip())
    number = _number(seconds[1] if seconds else first)
    if first and not (number > 0 and (seconds or number == int(number))):
        raise SpecError(
            f"--limit {first} is neither a positive number nor a time",
            hint="pass a number of poses or trajectories, such as 10, or a time, such as 30s",
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
    """Return the identity of a measurement: load, pose and trajectory.

    The dwells of a pose from both approach directions have the same identity.
    """
    return step.load, step.pose, step.trajectory


def _slower(step: Step, share: float) -> Step:
    return step if step.motion is None else replace(step, motion=_motion(step.motion, share))


def _motion(motion: Motion, share: float) -> Motion:
    """Return the same path, executed at the share `share` of the planned speed.

    The path of a straight joint-space line does not depend on its speed limits. All limits of a
    move are scaled by the same factor, so that acceleration and deceleration take as long as at
    full speed. If the acceleration were reduced more than the speed, short moves would be extremely
    slow.
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
