"""A motion streamed to the drives: the `Player` plays a `Track` row by row.

Everything a cycle needs is computed before the motion begins (`track`). In the cycle the player
takes the next row, brakes on the rest of the way when it is stopped, and holds where the motion
ended. A stop slows time down along the path, so all joints stay on it. The dynamic part of the
feed-forward torque falls with the square of the pace, the gravity torque stays; the torque of the
deceleration itself is left to the position loop.

In CSP the drives get positions, with a torque offset if wanted. In CSV and CST the master closes
the position loop (`gains`) with set-points that are `BEHIND` cycles old.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from hil.core import CommandRefused
from hil.robot import Status
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.bus import Inputs, Outputs
from hil_drivers.cia402.gains import Gains, torques, velocities, within
from hil_drivers.cia402.mapping import LATENCY
from hil_drivers.cia402.profile import INT16, wrapped
from hil_drivers.cia402.track import BEGINS_WITHIN_RAD, Track

BEHIND = LATENCY + 1
"""Cycles from `step` to the answer that shows its set-point: one until it is sent, then `LATENCY`.
"""

LONGEST_STOP_S = 5.0
"""Longest stop [s]; an arm that would need longer brakes harder."""
MOVING, HOLDING = int(Status.MOVING), int(Status.HOLDING)


class Player:
    """The commanded motion of all axes; one `step` a cycle, by the cyclic thread.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis, of position; its sign does not matter.
        feed_forward: Send the track's torque as 60B2h in CSP.
        gains: For CST and CSV.

    Attributes:
        segment, status: Of the row commanded last: the plan's step and `Status` bits.
        position, velocity, torque: The same row, raw.
        scale: Per axis, radians per increment, above 0.
        mode: CSP, CSV or CST; 0 while the drives are not enabled.
    """

    def __init__(
        self,
        period_s: float,
        rad_per_increment: Sequence[float],
        *,
        feed_forward: bool = False,
        gains: Gains | None = None,
    ) -> None:
        self._period_s, self.scale = period_s, [abs(rad) for rad in rad_per_increment]
        self._feed_forward, self._gains = feed_forward, gains
        self._lock = threading.Lock()
        self._loaded: Track | None = None
        self._begin: Track | None = None
        self._track: Track | None = None
        self._at, self._pace, self._slower = 0.0, 1.0, 0.0
        self._fade = Fade(len(self.scale), period_s)
        self.mode = 0
        self._commanded: deque[tuple[list[int], list[int]]] = deque(maxlen=BEHIND + 1)
        self.segment, self.status = -1, 0
        self._at_rest([0] * len(self.scale), [0] * len(self.scale))

    @property
    def moving(self) -> bool:
        """Whether set-points of a motion are left, or it brakes."""
        return self._track is not None or self._begin is not None

    def load(self, track: Track) -> None:
        """Keep the next motion for `start`; from any thread.

        Raises:
            CommandRefused: It is for another number of axes.
        """
        first = track.rows[0][0]  # makes all rows, in the thread that has time for it
        if len(first) != len(self.scale):
            raise CommandRefused(
                f"segment {track.segment} has {len(first)} axes, the arm {len(self.scale)}"
            )
        self._loaded = track

    def start(self) -> None:
        """Begin with the next cycle; from any thread.

        Raises:
            CommandRefused: Nothing is loaded, it does not begin where the arm is held, the last
                motion goes on, or the drives are not enabled.
        """
        with self._lock:
            track = self._loaded
            if track is None:
                raise CommandRefused("start without a prepared segment", hint="prepare one first")
            self._refuse_now(track)
            self._loaded, self._begin = None, track

    def stop(self, deceleration_rad_s2: float) -> None:
        """Come to rest on the rest of the way, slower and slower, and hold there; from any thread.

        Idempotent. What is loaded or about to begin is forgotten.
        """
        with self._lock:
            self._loaded = self._begin = None
            track = self._track
            if track is None or self._slower:
                return
            fastest = max(self._fastest(track, self._at - 1.0), self._fastest(track, self._at))
            lasts_s = min(fastest / self._period_s / deceleration_rad_s2, LONGEST_STOP_S)
            self._slower = self._pace if lasts_s <= 0.0 else self._period_s / lasts_s

    def engage(self, mode: int, outputs: Outputs) -> None:
        """The drives are enabled in a mode, with these preloaded targets: hold them."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            torque = outputs.torque_offset if mode == od.CSP else outputs.target_torque
            if not self.mode or mode == od.CSP:
                self._at_rest(outputs.target_position, torque)
            else:
                self._at_rest(self.position, torque)
            self.mode, self.status = mode, HOLDING

    def disengage(self) -> None:
        """The drives do not follow any more: there is no motion."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            self.mode, self.segment, self.status = 0, -1, 0

    def step(self, inputs: Inputs, outputs: Outputs) -> None:
        """Write the targets of the next cycle."""
        with self._lock:
            if self._begin is not None:
                self._set_out(self._begin)
            if self._track is not None:
                self._advance(self._track)
        outputs.segment, outputs.status = self.segment, self.status
        self._commanded.append((self.position, self.velocity))
        if self.mode == od.CSP:
            outputs.target_position[:] = self.position
            if self._feed_forward:
                outputs.torque_offset[:] = self._fade.faded(self.torque)
        elif self.mode == od.CSV:
            outputs.target_velocity[:] = self._led(inputs)
        elif self.mode == od.CST:
            outputs.target_torque[:] = self._controlled(inputs)
        if self.mode == outputs.mode[0] != od.CSP:
            # Drives do not look at it in these modes, recordings do. Not while the mode is
            # switched: then what is preloaded is where the axes are.
            outputs.target_position[:] = self.position

    def _set_out(self, track: Track) -> None:
        self._begin, self._track = None, track
        self._at, self._pace, self._slower = 0.0, 1.0, 0.0
        self.segment = track.segment
        self._fade.begin(self._fade.faded(self.torque), track.rows[0][2])

    def _advance(self, track: Track) -> None:
        """One row further; slower and slower when it brakes."""
        rows = track.rows
        if not self._slower:
            at = int(self._at)
            self.position, self.velocity, self.torque, holding = rows[at]
            self._at = at + 1.0
        else:
            holding = self._brake(track)
        self.status = MOVING
        if self._at >= len(rows) or not self._pace:
            self._rest_here(holding)

    def _brake(self, track: Track) -> list[int]:
        # `_at` is the row to come; the one commanded last is a whole step behind it.
        before, self._pace = self._pace, max(self._pace - self._slower, 0.0)
        passed = self._at - 1.0 + 0.5 * (before + self._pace)
        self.position, velocity, torque, holding = track.between(passed)
        self.velocity = [round(v * self._pace) for v in velocity]
        share = self._pace**2
        self.torque = [h + round(share * (m - h)) for m, h in zip(torque, holding, strict=True)]
        self._at = passed + 1.0
        return holding

    def _fastest(self, track: Track, at: float) -> float:
        """Of all joints, per cycle [rad]."""
        steps = track.steps_at(at)
        return max(abs(step) * by for step, by in zip(steps, self.scale, strict=True))

    def _rest_here(self, holding: list[int]) -> None:
        self._track = None
        if holding != self.torque:  # it ends with an acceleration
            self._fade.begin(self._fade.faded(self.torque), holding)
            self.torque = holding
        self.velocity = [0] * len(self.scale)
        self.status = HOLDING if self.mode else 0

    def _at_rest(self, position: Sequence[int], torque: Sequence[int]) -> None:
        self.position, self.torque = list(position), list(torque)
        self.velocity = [0] * len(self.scale)
        self._commanded.clear()
        self._fade.end()

    def _led(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CSV needs gains"
        return velocities(self._gains, self.velocity, self._commanded[0][0], inputs)

    def _controlled(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CST needs gains"
        torque = self._fade.faded(self.torque)
        return torques(self._gains, torque, *self._commanded[0], inputs)

    def _refuse_now(self, track: Track) -> None:
        where = f"segment {track.segment}"
        if not self.mode:
            raise CommandRefused(f"{where}: the drives are not enabled", hint="connect again")
        if self.moving:
            raise CommandRefused(
                f"{where}: segment {self.segment} is still running",
                hint="read until the status says HOLDING, or stop()",
            )
        far, axis = farthest(track.rows[0][0], self.position, self.scale)
        if far > BEGINS_WITHIN_RAD:
            raise CommandRefused(
                f"{where} begins {far:.4f} rad from where axis {axis + 1} is held",
                hint="plan it from the present q_target",
            )


def farthest(a: Sequence[int], b: Sequence[int], scale: Sequence[float]) -> tuple[float, int]:
    """Return the largest distance between positions, each times its scale, and its axis."""
    return max(
        (abs(wrapped(p - q)) * by, axis)
        for axis, (p, q, by) in enumerate(zip(a, b, scale, strict=True))
    )


FADE_S = 0.5
"""A step in the feed-forward torque (a model that is off, a mode switch) goes over this time."""


class Fade:
    """Feed-forward torque, without steps where one model or mode follows the other.

    Args:
        n: Axes.
        period_s: Device time of a cycle [s].
    """

    def __init__(self, n: int, period_s: float) -> None:
        self._n, self._per_cycle = n, period_s / FADE_S
        self.end()

    def begin(self, present: Sequence[int], torque: Sequence[int]) -> None:
        """Begin to fade from the present torque to the first one of the next motion [‰]."""
        self._bias = [now - then for now, then in zip(present, torque, strict=True)]
        self._left = 1.0

    def end(self) -> None:
        """There is no step any more."""
        self._bias, self._left = [0] * self._n, 0.0

    def faded(self, torque: list[int]) -> list[int]:
        """Return a row's torque with the rest of the step, and advance by a cycle."""
        if self._left <= 0.0:
            return torque
        self._left -= self._per_cycle
        share = max(self._left, 0.0)
        return [
            within(round(value + share * bias), INT16[1])
            for value, bias in zip(torque, self._bias, strict=True)
        ]
