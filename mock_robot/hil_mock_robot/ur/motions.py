"""The moves of a program: `movej`, `movel`, `movep`, alone or as a path with blends.

Constructors never fail: whatever speaks against a move is raised by the first `advance`, which is
when it is known where the arm stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.following import ToolFollower
from hil_mock_robot.ur.pieces import Piece
from hil_mock_robot.ur.poses import Numbers
from hil_mock_robot.ur.routes import Leg, Site, alike, joint_route, tool_route
from hil_mock_robot.ur.stopping import StopJoints

__all__ = ["Leg", "MoveJ", "MoveJPose", "MoveL", "MovePath"]

ROUNDING, BISECTIONS = 1 + 1e-9, 8
BRAKE_RAD_S2 = 8.0
"""A move begins at rest; an arm that still moves when it is commanded brakes with this first."""


class MovePath:
    """Moves one after the other, from rest to rest; implements `Motion`.

    Moves in the same space are blended where they have a radius: they leave their straight ways
    where the tool is that far from the waypoint, but never before half the way, and run from one
    way into the other on a parabola. Between moves in different spaces the arm stops.

    Args:
        arm: Its lengths and limits; None for joint moves without limits.
        tcp: (6,) tool in the flange frame, as set when the path is commanded.
        legs: The moves.
        tick_s: Device time of a tick.

    Attributes:
        progress: Index of the move under way; a blend belongs to the move that it begins.
    """

    def __init__(
        self, arm: ArmDescription | None, tcp: Numbers | None, legs: Sequence[Leg], tick_s: float
    ) -> None:
        self._site = Site(arm, None if tcp is None else np.array(tcp, dtype=np.float64))
        self._legs, self._tick_s = list(legs), tick_s
        self._planned = 0
        self._pieces: list[Piece] = []
        self._follower: ToolFollower | None = None
        self._t = 0.0
        self._pace: float | None = None
        self.progress = 0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `Motion`; the speed slider slows the time of the motion, not its way.

        Raises:
            MotionImpossible: With code 150 for a target beyond the joint limits, 154 for a way
                through a singularity or out of reach, 0 for a target out of reach.
        """
        if not self._pieces:
            if now[1].any():
                return StopJoints(BRAKE_RAD_S2, self._tick_s).advance(now, 1.0)
            self._plan(now[0])
            if not self._pieces:
                return None
        pace, change = self._slide(scale)
        self._t += 0.5 * (2.0 * pace - change) * self._tick_s
        while len(self._pieces) > 1 and self._t >= self._pieces[0].duration:
            self._t -= self._pieces.pop(0).duration
        piece = self._pieces[0]
        self.progress = piece.leg
        if self._t >= piece.duration:
            self._pieces = []
            return self._rest(piece, now)
        return self._moving(piece, pace, change / self._tick_s, now)

    def _plan(self, q: FloatArray) -> None:
        """The pieces of the moves that come next and can be blended."""
        while not self._pieces and self._planned < len(self._legs):
            first = self._planned
            legs = self._legs[first : first + alike(self._legs[first:])]
            self._planned += len(legs)
            self._t, self._follower = 0.0, None
            if legs[0].joint_space:
                self._pieces = joint_route(self._site, legs, first, q)
            else:
                self._pieces = tool_route(self._site, legs, first, q)
                self._follower = ToolFollower(*self._site.known, self._tick_s)

    def _slide(self, scale: float) -> tuple[float, float]:
        """The pace of this tick, and by how much it has changed.

        It goes to the slider as fast as the acceleration of the moves permits.
        """
        before = self._pace = scale if self._pace is None else self._pace
        if before != scale:
            self._pace += self._share(before, scale - before) * (scale - before)
        return self._pace, self._pace - before

    def _share(self, before: float, change: float) -> float:
        """How much of a change of the pace this tick permits, 0 to 1."""
        if self._permitted(before, change):
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (
                (middle, high) if self._permitted(before, middle * change) else (low, middle)
            )
        return low

    def _permitted(self, before: float, change: float) -> bool:
        """Whether the pace may change by so much in this tick."""
        rate, t = change / self._tick_s, self._t
        paces = (before, before + change)  # the profile may bend within the tick

        def fits(piece: Piece, at: float) -> bool:
            return max(piece.effort(at, pace, rate) for pace in paces) <= ROUNDING

        if not fits(self._pieces[0], t):
            return False
        t += (before + 0.5 * change) * self._tick_s
        for piece in self._pieces:
            if t < piece.duration or piece is self._pieces[-1]:
                return fits(piece, t)
            t -= piece.duration
        return True

    def _moving(self, piece: Piece, pace: float, change: float, now: Setpoint) -> Setpoint:
        moment = piece.at(self._t)
        if self._follower is not None:
            return self._follower.setpoint(moment, piece.anchor, pace, now)
        x, v, a = moment
        return np.array((x, pace * v, pace * pace * a + change * v))

    def _rest(self, piece: Piece, now: Setpoint) -> Setpoint:
        setpoint = self._moving(piece, 0.0, 0.0, now) if self._follower else None
        q = piece.at(piece.duration)[0] if setpoint is None else setpoint[0]
        return np.array((q, np.zeros(6), np.zeros(6)))


class MoveJ(MovePath):
    """URScript `movej` to a joint position: all joints start and arrive together.

    Args:
        q: (6,) [rad].
        v, a: Of the leading axis, the one that has furthest to go [rad/s, rad/s²].
        tick_s: Device time of a tick.
        time_s: How long it takes, in place of `v` and `a`, unless 0 [s].
        arm: Whose limits hold; None for none.
    """

    def __init__(
        self,
        q: Numbers,
        v: float,
        a: float,
        tick_s: float,
        *,
        time_s: float = 0.0,
        arm: ArmDescription | None = None,
    ) -> None:
        leg = Leg("j", np.array(q, dtype=np.float64), v, a, time_s=time_s)
        super().__init__(arm, None, [leg], tick_s)


class _MoveToPose(MovePath):
    """A single move to a pose.

    Args:
        arm: A UR arm.
        tcp: (6,) tool in the flange frame.
        pose: (6,) where to.
        v, a: Of the leading axis [rad/s, rad/s²], or of the tool [m/s, m/s²].
        tick_s: Device time of a tick.
        time_s: How long it takes, in place of `v` and `a`, unless 0 [s].
    """

    kind: Literal["j", "l"] = "j"

    def __init__(
        self,
        arm: ArmDescription,
        tcp: Numbers,
        pose: Numbers,
        v: float,
        a: float,
        tick_s: float,
        *,
        time_s: float = 0.0,
    ) -> None:
        leg = Leg(self.kind, np.array(pose, dtype=np.float64), v, a, time_s=time_s, is_pose=True)
        super().__init__(arm, tcp, [leg], tick_s)


class MoveJPose(_MoveToPose):
    """URScript `movej` to a pose: to the joint position nearest to the present one."""


class MoveL(_MoveToPose):
    """URScript `movel`: the tool moves on a straight line and turns about one axis.

    It turns with at most four times as many rad/s, rad/s² as `v` and `a` are.
    """

    kind: Literal["j", "l"] = "l"
