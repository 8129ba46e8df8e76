"""Compiled step: plant, friction, heat and servo for a whole block of samples in one call."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.core import FloatArray
from hil_mock_robot.plant.friction import COMPILED, friction_torque
from hil_mock_robot.plant.native import call, require_libraries
from hil_mock_robot.plant.records import Disturbances, Joints, Native, Room, Timing, Views
from hil_mock_robot.plant.servo import (
    drive_torque,
    feedforward_friction,
    integrate_error,
    interpolate,
)

require_libraries()

from numba import njit  # noqa: E402

CHANNELS = ("q", "qd", "current", "celsius", "current_target")
"""Outputs of the step per sample and joint, in the order of axis 1 of its output array."""

TRACKING_LIMIT_RAD = 0.2
OVERLOAD_S = 0.1

RUNAWAY_RAD_S = 100.0
"""Speed that no arm reaches [rad/s]. Above this speed the integration has diverged, and the
state must not be passed to MuJoCo."""

FAULT_TRACKING, FAULT_OVERLOAD, FAULT_RUNAWAY = 1, 2, 3


def _entry(stamp: int) -> Any:
    """Return the compiled entry point; `stamp` becomes part of the key of numba's cache."""

    @njit(cache=True, **COMPILED)
    def simulate(
        native: Native,
        views: Views,
        joints: Joints,
        outside: Disturbances,
        timing: Timing,
        room: Room,
        first: int,
        setpoints: FloatArray,
        out: FloatArray,
    ) -> Any:
        if stamp < 0:
            return 0, 0
        return _simulate(native, views, joints, outside, timing, room, first, setpoints, out)

    return simulate


@njit(**COMPILED)
def _simulate(
    native: Native,
    views: Views,
    joints: Joints,
    outside: Disturbances,
    timing: Timing,
    room: Room,
    first: int,
    setpoints: FloatArray,
    out: FloatArray,
) -> tuple[int, int]:
    """Advance the arm; see `simulate`."""
    period = timing.substeps * timing.dt
    for row in range(out.shape[0]):
        before, after = setpoints[row], setpoints[row + 1]
        _plan_feedforward(native, views, joints, after)
        for k in range(timing.substeps):
            call(native.step1, native.model, native.data)
            if k % timing.per_servo == 0:
                share = k / timing.substeps
                _command(views, joints, outside, before, after, share, period, timing)
            _act(views, joints, outside, timing.dt)
            call(native.step2, native.model, native.data)
            if _runs_away(views):
                return row, FAULT_RUNAWAY
        celsius = room.mean + room.swing * math.sin(
            room.omega * (first + row) * period + room.phase
        )
        _warm_up(joints, celsius, period)
        _write(views, joints, out[row])
        fault = _fault(views, joints, outside, after)
        if fault != 0:
            return row + 1, fault
    return out.shape[0], 0


@njit(**COMPILED)
def _plan_feedforward(native: Native, views: Views, joints: Joints, setpoint: FloatArray) -> None:
    """Compute the controller's feed-forward torque at the end of the sample."""
    for j in range(views.q.size):
        views.nominal_q[j] = setpoint[0, j]
        views.nominal_v[j] = setpoint[1, j]
        views.nominal_a[j] = setpoint[2, j]
    call(native.inverse, native.nominal_model, native.nominal_data)
    for j in range(views.q.size):
        state = joints.states[j]
        state.feedforward_0 = state.feedforward_1
        state.feedforward_1 = views.nominal_torque[j] + feedforward_friction(
            joints.servos[j], setpoint[1, j], views.nominal_torque[j]
        )


@njit(**COMPILED)
def _command(
    views: Views,
    joints: Joints,
    outside: Disturbances,
    before: FloatArray,
    after: FloatArray,
    share: float,
    period: float,
    timing: Timing,
) -> None:
    """Run one servo cycle, which sets the current of each joint."""
    cycle = timing.per_servo * timing.dt
    for j in range(views.q.size):
        servo, state = joints.servos[j], joints.states[j]
        torque = outside.torque[j]
        if math.isnan(torque):
            q, v = interpolate(before, after, share, period, j)
            error = q - views.q[j]
            moving = after[1, j] != 0.0 or before[1, j] != 0.0
            state.integral = integrate_error(servo, state.integral, error, moving, cycle)
            torque = servo.stiffness * error + servo.damping * (v - views.v[j]) + state.integral
            torque += state.feedforward_0 + share * (state.feedforward_1 - state.feedforward_0)
        else:
            state.integral = 0.0
        over = abs(torque) > servo.limit
        state.overload_s = state.overload_s + cycle if over else 0.0
        state.current = min(servo.limit, max(-servo.limit, torque)) / servo.gain


@njit(**COMPILED)
def _act(views: Views, joints: Joints, outside: Disturbances, dt: float) -> None:
    """Apply motor torque, friction and external torques for one integration step."""
    for j in range(views.q.size):
        state, v = joints.states[j], views.v[j]
        load = state.torque - state.friction - joints.rotors[j] * views.a[j]
        state.friction = friction_torque(
            joints.laws[j], joints.shares[j], joints.stiffness[j], joints.forces[j],
            views.q[j], v, load, state.celsius, outside.wear[j], dt,
        )  # fmt: skip
        state.torque = drive_torque(joints.servos[j], state.current)
        views.applied[j] = state.torque - state.friction + outside.push[j]
        copper = joints.heats[j].copper * state.current * state.current
        state.heat_j += (max(0.0, state.friction * v) + copper) * dt


@njit(**COMPILED)
def _runs_away(views: Views) -> bool:
    calm = True
    for j in range(views.v.size):
        # A comparison with NaN is false, so NaN counts as a runaway, too.
        calm = calm and abs(views.v[j]) < RUNAWAY_RAD_S
    return not calm


@njit(**COMPILED)
def _warm_up(joints: Joints, ambient: float, period: float) -> None:
    """Apply first-order warming by the losses of one sample."""
    for j in range(joints.states.size):
        state, heat = joints.states[j], joints.heats[j]
        target = ambient + heat.idle_k + heat.k_per_w * state.heat_j / period
        state.celsius += (target - state.celsius) * period / heat.tau_s
        state.heat_j = 0.0


@njit(**COMPILED)
def _write(views: Views, joints: Joints, row: FloatArray) -> None:
    for j in range(views.q.size):
        state = joints.states[j]
        row[0, j] = views.q[j]
        row[1, j] = views.v[j]
        row[2, j] = state.current
        row[3, j] = state.celsius
        row[4, j] = state.feedforward_1 / joints.servos[j].gain


@njit(**COMPILED)
def _fault(views: Views, joints: Joints, outside: Disturbances, setpoint: FloatArray) -> int:
    for j in range(views.q.size):
        if joints.states[j].overload_s > OVERLOAD_S:
            return FAULT_OVERLOAD
        controlled = math.isnan(outside.torque[j])
        if controlled and abs(views.q[j] - setpoint[0, j]) > TRACKING_LIMIT_RAD:
            return FAULT_TRACKING
    return 0


def _stamp() -> int:
    """Return a number that changes with every file whose functions are compiled into the step."""
    names = ("native", "records", "friction", "servo", "step")
    files = [Path(__file__).with_name(f"{name}.py") for name in names]
    return zlib.crc32(b"".join(file.read_bytes() for file in files))


simulate: Callable[..., tuple[int, int]] = _entry(_stamp())
"""Function that advances the arm sample by sample.

Args:
    native, views, joints, outside, timing, room: Robot and its surroundings; states are updated in
        place.
    first: Number of samples since power-on.
    setpoints: (N + 1, 3, n) position, velocity and acceleration; row 0 is the end of the last
        block, and the arm follows row i + 1 during sample i.
    out: (N, len(CHANNELS), n) output array for the true state at the end of each sample.

Returns:
    Number of simulated samples, and fault code (0 for no fault). No samples are simulated after a
    fault.
"""
