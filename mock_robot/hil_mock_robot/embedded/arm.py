"""Arm of the embedded robot: commands as input, state rows as output.

`Arm` adds commands, faults and brakes to a `ServoArm`, `Motion` contains the set-points to play,
and `Sampling` converts commands and measurements to state rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray, IntArray, StructArray
from hil.robot import Limits, Segment, Status, state_dtype
from hil_mock_robot.embedded.options import (
    Options,
    mount_of,
    mounted_of,
    require_same_mount,
    start_of,
    truth_of,
    wear_of,
)
from hil_mock_robot.plant.records import EMERGENCY_STOP, RUNAWAY, timing_of
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.truth import published

if TYPE_CHECKING:  # importing takes a second, and only `connect` needs it
    from hil_mock_robot.plant.servo_arm import ServoArm
    from hil_mock_robot.plant.simulation import Samples, Simulation


FULL_BRAKES = 1.0
"""Deceleration of an emergency stop, as a share of the acceleration limit."""

BRAKING_SHARE = 0.5
"""Deceleration of a normal stop, as a share of the acceleration limit."""


class Arm:
    """Arm of one mock robot, before and after power-on.

    Args:
        model: Name of a built-in arm.
        options: Options of the robot in the station file.

    Attributes:
        truth: True parameters of the robot.
        description: Published description of the arm.
        rate_hz: Samples per second.
        motion: Set-points of the controller.
        gravity: Gravity in the base frame [m/s²].
        servo: Arm under its servo; None before power-on.
        fault: Fault code: 0, or a code of `FAULTS` until `switch_on`.
        locked: Whether the mechanical brakes hold the arm.

    Raises:
        SpecError: There is no such arm, or an option is invalid.
    """

    def __init__(self, model: str, options: Options) -> None:
        self.truth = truth_of(model, options)
        self.description = published(self.truth.arm)
        self.rate_hz = options.rate_hz or self.description.rate_hz
        timing_of(self.rate_hz, options.substep_hz)
        self._options = options
        self._wear = wear_of(options, self.description.n_joints)
        self._sensors = Sensors(self.truth, options.day)
        self.motion = Motion(self.limits, self.rate_hz, start_of(self.description, options))
        self._mounted = mounted_of(options)
        self.gravity = mount_of(options)
        self.servo: ServoArm | None = None
        self.fault = 0
        self.locked = False

    @property
    def limits(self) -> Limits:
        """Published limits of the arm."""
        arm = self.description
        return Limits(
            arm.q_min, arm.q_max, arm.qd_max, arm.qdd_max, arm.effort_max, arm.payload_max_kg
        )

    @property
    def powered(self) -> ServoArm:
        """Arm under its servo; available after power-on only."""
        assert self.servo is not None
        return self.servo

    @property
    def on(self) -> Simulation:
        """Simulation of the arm; available after power-on only."""
        return self.powered.simulation

    @property
    def device_time(self) -> float:
        """Time of the controller's clock [s]."""
        return self.on.samples / self.rate_hz if self.servo else 0.0

    @property
    def fastest(self) -> float:
        """True speed of the fastest joint [rad/s]."""
        return float(np.abs(self.on.speed).max()) if self.servo else 0.0

    @property
    def dead(self) -> bool:
        """Whether the simulation has diverged, so that there are no samples until `switch_on`."""
        return self.fault == RUNAWAY

    @property
    def moving(self) -> bool:
        """Whether the controller commands a motion."""
        return self.motion.moving or self.torque_controlled

    @property
    def torque_controlled(self) -> bool:
        """Whether torques are commanded instead of positions."""
        return bool(np.isfinite(self.on.disturbances.torque).any())

    def build(self) -> ServoArm:
        """Return the current arm for `switch_on`, or build a new arm, which takes seconds."""
        if self.servo is not None and not self.dead:
            return self.servo
        from hil_mock_robot.plant.servo_arm import ServoArm
        from hil_mock_robot.plant.simulation import Setting

        options = self._options
        return ServoArm(
            self.truth,
            Setting(self.rate_hz, options.substep_hz, self.gravity, options.temperature_c),
            start_of(self.description, options),
            mounted=self._mounted,
            declared=None if self.servo is None else self.servo.declared,
            wear=self._wear,
            sensors=self._sensors,
        )

    def switch_on(self, servo: ServoArm) -> None:
        """Use the arm that `build` returned, and clear a fault."""
        if self.fault:
            servo.brake()
            servo.release()
            self.motion.coast(servo.position, servo.speed)
        self.servo, self.fault, self.locked = servo, 0, False

    def mount(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set the gravity of the station in the base frame.

        Raises:
            SpecError: The option `mount` contradicts the station.
            CommandRefused: The robot is already switched on.
        """
        if self.servo is not None:
            raise CommandRefused("the mount cannot change once the mock robot is switched on")
        require_same_mount(self._options, gravity_m_s2)
        self.gravity = gravity_m_s2

    def set_payload(self, payload: Payload) -> None:
        """Declare a payload, and mount it unless the option `mounted_payload` is set.

        Raises:
            CommandRefused: The payload is too heavy, or the arm is moving.
        """
        arm = self.description
        if not 0 <= payload.mass <= arm.payload_max_kg:
            raise CommandRefused(
                f"payload of {payload.mass:g} kg: the {arm.name} carries "
                f"0 to {arm.payload_max_kg:g} kg",
                hint="declare a lighter load",
            )
        if self.motion.moving:
            raise CommandRefused(
                "the payload cannot change during a motion", hint="call stop() first"
            )
        self.powered.declare(payload)

    def brake(self) -> None:
        """Decelerate along the current path with half of the acceleration limit, then hold."""
        if self.torque_controlled:
            self.command_torque(None)
        if not self.fault:
            self.motion.brake()

    def trip(self, fault: int) -> None:
        """Stop the arm because of a fault of the controller (a code of `FAULTS`)."""
        if self.fault:
            return
        if self.torque_controlled:
            self.command_torque(None)
        self.motion.brake(FULL_BRAKES if fault == EMERGENCY_STOP else BRAKING_SHARE)
        self.fault = fault

    def lock(self, fault: int) -> None:
        """Close the mechanical brakes after a failure of the servo (a code of `FAULTS`)."""
        self.fault, self.locked = fault, True
        if not self.dead:
            self.powered.brake()
            self.on.disturbances.torque[:] = np.nan
            self.motion.coast(self.on.position, self.on.speed)

    def command_torque(self, torque: FloatArray | None) -> None:
        """Command joint torques (n,) [N·m].

        With None, torque control ends, and the arm brakes and holds its position.
        """
        simulation = self.on
        if torque is not None:
            self.motion.brake()
            simulation.disturbances.torque[:] = torque
            return
        simulation.disturbances.torque[:] = np.nan
        simulation.track(simulation.position, simulation.speed)
        self.motion.coast(simulation.position, simulation.speed)


START_TOLERANCE_RAD = 1e-4
REST_TOLERANCE_RAD_S = 1e-3

RELATIVE_TOLERANCE = 1e-6
"""Relative tolerance of limits, because planners reach a limit exactly, up to rounding errors."""

LEAST_BRAKING_S = 0.05


class Motion:
    """Commanded set-points: one segment at a time, followed by a hold at the end of the segment.

    Args:
        limits: Joint limits that segments must not exceed.
        rate_hz: Samples per second.
        q: (n,) initial position [rad].
    """

    def __init__(self, limits: Limits, rate_hz: float, q: FloatArray) -> None:
        self._limits, self._rate = limits, rate_hz
        self._path = _at_rest(q)[None]
        self._cursor = 1
        self._prepared: Segment | None = None
        self._braking = 0.0
        self.segment = -1

    @property
    def moving(self) -> bool:
        """Whether set-points remain to be played."""
        return self._cursor < len(self._path)

    def prepare(self, segment: Segment) -> None:
        """Check the segment and store it for `start`.

        Raises:
            CommandRefused: The segment exceeds the limits, or does not begin at rest at the end of
                the current path.
        """
        problems = _problems(segment, self._limits, self._rate, self._path[-1, 0])
        if problems:
            raise CommandRefused(
                f"segment {segment.index} ({segment.kind}): " + "; ".join(problems),
                hint="plan the segment from the present q_target and within the robot's limits",
            )
        self._prepared = segment

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: No segment is prepared, or the last segment is still running.
        """
        if self._prepared is None:
            raise CommandRefused("start without a prepared segment", hint="call prepare() first")
        if self.moving:
            raise CommandRefused(
                f"segment {self.segment} is still running",
                hint="read until the status says HOLDING, or stop()",
            )
        segment, self._prepared = self._prepared, None
        self._path = np.stack((segment.q, segment.qd, segment.qdd), axis=1).astype(np.float64)
        self._path[-1, 1:] = 0.0
        self._cursor, self._braking, self.segment = 0, 0.0, segment.index

    def take(self, count: int) -> tuple[FloatArray, IntArray]:
        """Return up to `count` set-points (k, 3, n) and their status bits (k,).

        The returned set-points end with the segment. At rest, the last set-point is repeated. The
        sample that reaches the last set-point already has the status HOLDING.
        """
        if not self.moving:
            held = np.repeat(self._path[-1:], count, axis=0)
            return held, np.full(count, int(Status.HOLDING))
        rows = self._path[self._cursor : self._cursor + count]
        self._cursor += len(rows)
        status = np.full(len(rows), int(Status.MOVING))
        if not self.moving:
            status[-1] = int(Status.HOLDING)
        return rows, status

    def brake(self, share: float = BRAKING_SHARE) -> None:
        """Decelerate to rest on the remaining path, by slowing down time.

        If a stop with at least this deceleration is already active, it continues unchanged.

        Args:
            share: Deceleration as a share of the acceleration limit.
        """
        self._prepared = None
        if not self.moving or self._braking >= share:
            return
        # Before its first sample, a segment is at the end of the last one.
        passed = max(self._cursor - 1, 0)
        limit = share * self._limits.qdd_max
        self._replace(_slowed(self._path[passed:], self._rate, limit))
        self._braking = share

    def coast(self, q: FloatArray, qd: FloatArray) -> None:
        """Decelerate to rest from a position (n,) and a speed (n,) that are not on a path.

        The method is needed after torque control and after a fault.
        """
        self._prepared = None
        duration = _braking_time(qd, BRAKING_SHARE * self._limits.qdd_max)
        t = np.arange(1, np.ceil(duration * self._rate) + 1)[:, None] / self._rate
        left = np.clip(1 - t / duration, 0.0, None)
        done = np.minimum(t, duration)
        q_path = q + qd * (done - done**2 / (2 * duration))
        qdd = np.where(left > 0, -qd / duration, 0.0)
        self._replace(np.stack((q_path, qd * left, qdd), axis=1))

    def _replace(self, path: FloatArray) -> None:
        path[-1, 1:] = 0.0
        self._path, self._cursor, self._braking = path, 0, 0.0


def _at_rest(q: FloatArray) -> FloatArray:
    return np.stack((q, np.zeros_like(q), np.zeros_like(q)))


def _problems(segment: Segment, limits: Limits, rate: float, start: FloatArray) -> list[str]:
    """Return all problems of a segment."""
    shape = segment.q.shape
    if (
        shape[1:] != start.shape
        or shape[0] < 1
        or not shape == segment.qd.shape == segment.qdd.shape
    ):
        return [f"q, qd, qdd must all be (N, {len(start)}), not {shape}"]
    if not all(np.isfinite(a).all() for a in (segment.q, segment.qd, segment.qdd)):
        return ["a set-point is not a finite number"]
    found = _range_problems(segment, limits, rate)
    gap = np.abs(segment.q[0] - start)
    if gap.max() > START_TOLERANCE_RAD:
        j = int(gap.argmax())
        found.append(
            f"joint {j + 1} starts {np.degrees(gap[j]):.3f}° away from its present position"
        )
    # The first set-point is one period after rest, so it may have the speed of one period.
    first = np.abs(segment.qd[0]) - limits.qdd_max / rate
    if max(first.max(), np.abs(segment.qd[-1]).max()) > REST_TOLERANCE_RAD_S:
        found.append("it must start and end at standstill")
    if segment.kind == "hold" and shape[0] != 1:
        found.append("a hold must have one set-point")
    return found


def _range_problems(segment: Segment, limits: Limits, rate: float) -> list[str]:
    wide = 1 + RELATIVE_TOLERANCE
    span = RELATIVE_TOLERANCE * (limits.q_max - limits.q_min)
    steps = np.abs(np.diff(segment.q, axis=0)) * rate
    checks = (
        ("leaves its position range", (segment.q < limits.q_min - span).any(axis=0)),
        ("leaves its position range", (segment.q > limits.q_max + span).any(axis=0)),
        ("exceeds its speed limit", (np.abs(segment.qd) > limits.qd_max * wide).any(axis=0)),
        (
            "has position steps above its speed limit",
            (steps > limits.qd_max * wide).any(axis=0),
        ),
        (
            "exceeds its acceleration limit",
            (np.abs(segment.qdd) > limits.qdd_max * wide).any(axis=0),
        ),
    )
    return [f"joint {j + 1} {what}" for what, bad in checks for j in np.flatnonzero(bad)]


def _slowed(path: FloatArray, rate: float, deceleration: FloatArray) -> FloatArray:
    """Return the path (M, 3, n) from its first row, slowed down until rest.

    The rate at which the path is played decreases linearly from 1 to 0, so a joint with speed v has
    the deceleration v / duration.
    """
    duration = _braking_time(path[0, 1], deceleration)
    t = np.minimum(np.arange(1, np.ceil(duration * rate) + 1) / rate, duration)
    pace = 1 - t / duration
    progress = (t - t**2 / (2 * duration)) * rate
    q, qd, qdd = _between_samples(path, np.minimum(progress, len(path) - 1), rate)
    pace = pace[:, None]
    return np.stack((q, qd * pace, qdd * pace**2 - qd / duration), axis=1)


def _braking_time(qd: FloatArray, deceleration: FloatArray) -> float:
    return max(LEAST_BRAKING_S, float(np.max(np.abs(qd) / deceleration)))


def _between_samples(
    path: FloatArray, at: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a cubic interpolation of a path at fractional rows; accelerations are linear."""
    row = np.minimum(at.astype(np.int64), max(len(path) - 2, 0))
    after = np.minimum(row + 1, len(path) - 1)
    s = (at - row)[:, None]
    q0, v0, a0 = path[row, 0], path[row, 1] / rate, path[row, 2]
    q1, v1, a1 = path[after, 0], path[after, 1] / rate, path[after, 2]
    quadratic, cubic = 3 * (q1 - q0) - 2 * v0 - v1, v0 + v1 - 2 * (q1 - q0)
    q = q0 + s * (v0 + s * (quadratic + s * cubic))
    qd = (v0 + s * (2 * quadratic + 3 * s * cubic)) * rate
    return q, qd, a0 + s * (a1 - a0)


EPOCH_S = 1_767_225_600.0
"""Host time at which every mock robot is switched on: 2026-01-01 00:00 UTC."""

MODE_TORQUE = 1
"""Value of `mode` in a row for torque control; 0 for position control."""

FAULTY = int(Status.FAULT | Status.MASKED)


class Sampling:
    """Sampler that advances the simulation of an arm and measures its state.

    Args:
        arm: Arm, which must be switched on before the first sample.

    Attributes:
        qd: (N, n) true joint speeds of the newest samples [rad/s].
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._dtype = state_dtype(arm.description.n_joints)
        self.qd: FloatArray = np.zeros((0, arm.description.n_joints))

    def advance(self, count: int) -> StructArray:
        """Return up to `count` state rows, at most to the end of the running segment.

        A fault ends the samples, and the last row contains the code of the fault. A diverged
        simulation returns no rows.
        """
        arm, before = self._arm, self._arm.fault
        if arm.dead:
            return np.zeros(0, dtype=self._dtype)
        rows, samples = (self._by_torque if arm.torque_controlled else self._by_position)(count)
        self.qd = samples["qd"]
        if samples.fault:
            arm.lock(samples.fault)
        if arm.fault:
            faulty = rows if before else rows[-1:]
            faulty["status"] |= FAULTY
            faulty["fault_code"] = arm.fault
        return rows

    def _by_position(self, count: int) -> tuple[StructArray, Samples]:
        arm = self._arm
        setpoints, status = arm.motion.take(count)
        first = arm.on.samples
        samples = arm.powered.follow(setpoints)
        rows = self._measured(samples, first)
        done = len(rows)
        rows["status"] = status[:done]
        for k, field in enumerate(("q_target", "qd_target", "qdd_target")):
            rows[field] = setpoints[:done, k]
        rows["effort_target"] = samples["current_target"]
        return rows, samples

    def _by_torque(self, count: int) -> tuple[StructArray, Samples]:
        arm, simulation = self._arm, self._arm.on
        simulation.track(simulation.position, np.zeros(arm.description.n_joints))
        held = np.repeat(simulation.setpoint[None], count, axis=0)
        first = simulation.samples
        samples = simulation.advance(held)
        rows = self._measured(samples, first)
        rows["status"], rows["mode"] = int(Status.MOVING), MODE_TORQUE
        for field in ("q_target", "qd_target", "qdd_target"):
            rows[field] = np.nan
        rows["effort_target"] = simulation.disturbances.torque / arm.description.drive_gains
        return rows, samples

    def _measured(self, samples: Samples, first: int) -> StructArray:
        """Return rows with all measured fields."""
        arm = self._arm
        rows = np.zeros(len(samples), dtype=self._dtype)
        rows["device_time"] = (first + 1 + np.arange(len(rows))) / arm.rate_hz
        rows["host_time"] = EPOCH_S + rows["device_time"]
        rows["segment"] = arm.motion.segment
        measured = arm.powered.measure(samples)
        rows["q"], rows["qd"], rows["effort"], rows["temperature"] = measured
        return rows
