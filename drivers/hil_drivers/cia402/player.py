"""Player that streams a motion to the drives: one row of a `Track` per cycle.

All values that a cycle needs are computed before the motion begins (`track`). In each cycle the
player sends the next row. After a stop the player brakes along the remaining path, and at the end
of the motion the player holds the last position. A stop slows the progress along the path down, so
that all joints stay on the path. During a stop, the dynamic part of the feed-forward torque
decreases with the square of the pace, whereas the gravity torque does not change. The position loop
provides the torque for the deceleration.

In the mode CSP the drives receive positions, optionally with a torque offset. In CSV and CST the
master closes the position loop (`gains`) with set-points that are `BEHIND` cycles old.
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
"""Number of cycles from `step` to the answer that shows the set-point: 1 + `LATENCY`."""

LONGEST_STOP_S = 5.0
"""Longest duration of a stop [s]; a higher deceleration is used if a stop would take longer."""
MOVING, HOLDING = int(Status.MOVING), int(Status.HOLDING)


class Player:
    """Commanded motion of all axes; the cyclic thread calls `step` once a cycle.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Position scale per axis [rad per increment]; its sign has no effect.
        feed_forward: Whether the torques of the track are sent as 60B2h in CSP.
        gains: Gains of the position control in CST and CSV.

    Attributes:
        segment: Number of the plan's step to which the last commanded row belongs.
        status: `Status` bits of the last commanded row.
        position: Positions of the last commanded row as raw values, one per axis.
        velocity: Velocities of the last commanded row as raw values, one per axis.
        torque: Torques of the last commanded row as raw values, one per axis.
        scale: Absolute value of the position scale per axis [rad per increment].
        mode: Mode of operation: CSP, CSV or CST; 0 while the drives are not enabled.
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
        """Whether a motion is running, about to begin, or braking."""
        return self._track is not None or self._begin is not None

    def load(self, track: Track) -> None:
        """Store the next motion for `start`; any thread can call this.

        Raises:
            CommandRefused: The number of axes of the motion is wrong.
        """
        first = track.rows[0][0]  # computes all rows outside of the cyclic thread
        if len(first) != len(self.scale):
            raise CommandRefused(
                f"segment {track.segment} has {len(first)} axes, the arm {len(self.scale)}"
            )
        self._loaded = track

    def start(self) -> None:
        """Start the loaded motion with the next cycle; any thread can call this.

        Raises:
            CommandRefused: No motion is loaded, the loaded motion does not begin at the held
                position, another motion is still running, or the drives are not enabled.
        """
        with self._lock:
            track = self._loaded
            if track is None:
                raise CommandRefused("no segment is prepared", hint="prepare a segment first")
            self._refuse_now(track)
            self._loaded, self._begin = None, track

    def stop(self, deceleration_rad_s2: float) -> None:
        """Decelerate along the remaining path, then hold; any thread can call this.

        Idempotent. A motion that is loaded or about to begin is dropped.

        Args:
            deceleration_rad_s2: Deceleration of the fastest joint [rad/s²].
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
        """Begin to hold the preloaded targets after the drives were enabled in a mode."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            torque = outputs.torque_offset if mode == od.CSP else outputs.target_torque
            if not self.mode or mode == od.CSP:
                self._at_rest(outputs.target_position, torque)
            else:
                self._at_rest(self.position, torque)
            self.mode, self.status = mode, HOLDING

    def disengage(self) -> None:
        """Drop all motions, because the drives no longer follow set-points."""
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
            # Drives ignore it in these modes, but recordings use it. While the mode is switched,
            # the preloaded targets are the measured positions and must not be replaced.
            outputs.target_position[:] = self.position

    def _set_out(self, track: Track) -> None:
        self._begin, self._track = None, track
        self._at, self._pace, self._slower = 0.0, 1.0, 0.0
        self.segment = track.segment
        self._fade.begin(self._fade.faded(self.torque), track.rows[0][2])

    def _advance(self, track: Track) -> None:
        """Advance along the track by one row, or by less than one row while braking."""
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
        # `_at` is the next row; the row commanded last is one step before it.
        before, self._pace = self._pace, max(self._pace - self._slower, 0.0)
        passed = self._at - 1.0 + 0.5 * (before + self._pace)
        self.position, velocity, torque, holding = track.between(passed)
        self.velocity = [round(v * self._pace) for v in velocity]
        share = self._pace**2
        self.torque = [h + round(share * (m - h)) for m, h in zip(torque, holding, strict=True)]
        self._at = passed + 1.0
        return holding

    def _fastest(self, track: Track, at: float) -> float:
        """Return the distance that the fastest joint moves in one cycle [rad]."""
        steps = track.steps_at(at)
        return max(abs(step) * by for step, by in zip(steps, self.scale, strict=True))

    def _rest_here(self, holding: list[int]) -> None:
        self._track = None
        if holding != self.torque:  # the motion ends with an acceleration
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
                hint="read until the status is HOLDING, or call stop()",
            )
        far, axis = farthest(track.rows[0][0], self.position, self.scale)
        if far > BEGINS_WITHIN_RAD:
            raise CommandRefused(
                f"{where} begins {far:.4f} rad from the held position of axis {axis + 1}",
                hint="plan the segment from the present q_target",
            )


def farthest(a: Sequence[int], b: Sequence[int], scale: Sequence[float]) -> tuple[float, int]:
    """Return the largest joint distance between two positions [rad], and the number of its axis."""
    return max(
        (abs(wrapped(p - q)) * by, axis)
        for axis, (p, q, by) in enumerate(zip(a, b, scale, strict=True))
    )


FADE_S = 0.5
"""Duration over which a step in the feed-forward torque is faded [s].

Steps in the feed-forward torque result from model errors and from changes of the mode.
"""


class Fade:
    """Fading of the feed-forward torque that avoids steps at a change of motion or mode.

    Args:
        n: Number of axes.
        period_s: Device time of a cycle [s].
    """

    def __init__(self, n: int, period_s: float) -> None:
        self._n, self._per_cycle = n, period_s / FADE_S
        self.end()

    def begin(self, present: Sequence[int], torque: Sequence[int]) -> None:
        """Begin to fade from the present torque to the first torque of the next motion [‰]."""
        self._bias = [now - then for now, then in zip(present, torque, strict=True)]
        self._left = 1.0

    def end(self) -> None:
        """End the fading: discard the remaining step of the torque."""
        self._bias, self._left = [0] * self._n, 0.0

    def faded(self, torque: list[int]) -> list[int]:
        """Return the torque of a row plus the remaining step; advance the fading by one cycle."""
        if self._left <= 0.0:
            return torque
        self._left -= self._per_cycle
        share = max(self._left, 0.0)
        return [
            within(round(value + share * bias), INT16[1])
            for value, bias in zip(torque, self._bias, strict=True)
        ]
