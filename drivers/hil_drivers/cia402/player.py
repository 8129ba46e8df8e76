"""Plays a motion to the drives row by row, brakes on its way, and holds where it ended."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from hil.core import CommandRefused
from hil.robot import Status
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.contracts import Inputs, Outputs
from hil_drivers.cia402.control import Fade, Gains, torques, velocities
from hil_drivers.cia402.track import Track, farthest

__all__ = ["Gains", "Player", "Track"]

BEHIND = 3
"""Cycles from writing a set-point to the answer that shows it: it is sent in the next one, applied
at the SYNC after that, reached by the third."""

BEGINS_WITHIN_RAD = 1e-4
LONGEST_STOP_S = 5.0
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
        mode: What is played: CSP, CSV or CST; 0 while the drives are not enabled.
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
        self._told: deque[tuple[list[int], list[int]]] = deque(maxlen=BEHIND + 1)
        self.segment, self.status = -1, 0
        self._at_rest([0] * len(self.scale), [0] * len(self.scale))

    @property
    def moving(self) -> bool:
        """Whether set-points of a motion are left, or it brakes."""
        return self._track is not None or self._begin is not None

    def load(self, track: Track) -> None:
        """Keep the next motion for `start`; from any thread.

        Raises:
            CommandRefused: It does not begin where the arm is held.
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

    def hold(self) -> None:
        """Be done with the motion at once and hold the set-point commanded last."""
        with self._lock:
            self._loaded = self._begin = None
            self._rest_here()

    def engage(self, mode: int, outputs: Outputs) -> None:
        """The drives are enabled in a mode, with these preloaded targets: hold them."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            held = outputs.torque_offset if mode == od.CSP else outputs.target_torque
            if not self.mode or mode == od.CSP:
                self._at_rest(outputs.target_position, held)
            else:
                self._at_rest(self.position, held)
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
        self._told.append((self.position, self.velocity))
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
            self.position, self.velocity, self.torque = rows[at]
            self._at = at + 1.0
        else:
            self._brake(track)
        self.status = MOVING
        if self._at >= len(rows) or not self._pace:
            self._rest_here()

    def _brake(self, track: Track) -> None:
        # `_at` is the row to come; the one commanded last is a whole step behind it.
        before, self._pace = self._pace, max(self._pace - self._slower, 0.0)
        passed = self._at - 1.0 + 0.5 * (before + self._pace)
        self.position, velocity, self.torque = track.between(max(passed, 0.0))
        self.velocity = [round(v * self._pace) for v in velocity]
        self._at = passed + 1.0

    def _fastest(self, track: Track, at: float) -> float:
        """Of all joints, per cycle [rad]."""
        steps = track.steps_at(max(at, 0.0))
        return max(abs(step) * by for step, by in zip(steps, self.scale, strict=True))

    def _rest_here(self) -> None:
        self._track = None
        self.velocity = [0] * len(self.scale)
        self.status = HOLDING if self.mode else 0

    def _at_rest(self, position: Sequence[int], torque: Sequence[int]) -> None:
        self.position, self.torque = list(position), list(torque)
        self.velocity = [0] * len(self.scale)
        self._told.clear()
        self._fade.end()

    def _led(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CSV needs gains"
        return velocities(self._gains, self.velocity, self._told[0][0], inputs)

    def _controlled(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CST needs gains"
        torque = self._fade.faded(self.torque)
        return torques(self._gains, torque, *self._told[0], inputs)

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
