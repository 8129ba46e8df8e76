"""Emulation of the control script that `ur-rtde` uploads: commands in registers, tick by tick.

The client writes a command number and its arguments into input registers and waits for READY and
DONE in an output register (docs/reference/mock-ur-control.md). Source: behaviour of the script that
ur-rtde 1.6.5 uploads, for each version of the controller's software.

Tables at the end of each section map command numbers to handlers: moves, streams (a thread that
continues until its stop command), queries about kinematics and dynamics, settings, and contacts. If
the script for the simulated software lacks a query, the mock writes no register. After a query that
the script lacks, the client reads the previous register contents, as on a real controller.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.kinematics import (
    Numbers,
    frame_of,
    jacobian,
    pose_of,
    pose_trans,
    tool_velocity,
    turned,
)
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.motion import ServoJ, SpeedJ, SpeedL
from hil_mock_robot.ur.program import (
    SINCE,
    Operation,
    Registers,
    Steps,
    Threaded,
    Touch,
    follow,
    is_steady,
    joint_torques,
    joints_of,
    pose_at,
    set_payload,
    set_tcp,
    set_watchdog,
    speed_motion,
    stop_joints,
    stop_line,
    within_limits,
)
from hil_mock_robot.ur.routes import Leg

READY, DONE = 1, 2
NO_COMMAND, STOP_SCRIPT = 0, 255

CONTINUOUS = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Commands that are executed again in every tick while they are in the command register."""


class ControlScript(Threaded):
    """Program that plays while `RTDEControlInterface` is connected.

    Args:
        offset: Number of the first register: 0 or 24.
        path: Moves of MOVE_PATH, each with the progress values that are reported before the move.

    Attributes:
        registers: Registers shared with the client; set by `main`.
        path: Moves of MOVE_PATH with their progress values.
        operation: State of the asynchronous operation.
        touch: Contact detector with the history of the joint positions.
        internal: Command that the script issues to itself.
        stop_linear: Whether stopJ and stopL stop along a line in tool space; the script stores this
            setting between commands.
        servo: Target of the servo thread: joints (6,), time, lookahead, gain.
        speed, jog: Commands of the speed thread and of the jog thread: whether the TCP moves in a
            line, speed (6,), acceleration.
        contact: Number of ticks since the contact that the contact thread has detected.
        waypoint: Target TCP pose of the present move, (6,); None before the first move.
    """

    registers: Registers
    operation: Operation

    def __init__(self, offset: int = 0, path: Sequence[tuple[tuple[int, ...], Leg]] = ()) -> None:
        super().__init__("rtde_control")
        self._offset = offset
        self.path = tuple(path)
        self.touch = Touch()
        self.internal = NO_COMMAND
        self.stop_linear = False
        self.waypoint: Numbers | None = None
        self.servo: tuple[FloatArray, float, float, float] = (np.zeros(6), 0.0, 0.1, 300.0)
        self.speed = self.jog = (True, np.zeros(6), 0.0)
        self.contact = 0

    def tick(self, machine: Machine) -> bool:
        """Execute one tick of the script; see `Program`."""
        self.touch.look(machine)
        return super().tick(machine)

    def main(self) -> Steps:
        """Execute the commands in the command register until `STOP_SCRIPT`."""
        self.registers = Registers(self.machine, self._offset)
        self.operation = Operation(self.registers)
        executed = False
        self._signal(READY)
        while True:
            command = self._command()
            if command in CONTINUOUS:
                yield from self._carry_out(command)
                self._signal(READY)
            elif command == NO_COMMAND:
                executed = False
                self._signal(READY)
            elif not executed:
                yield from self._carry_out(command)
                if command == STOP_SCRIPT:
                    return
                self._signal(DONE)
                executed = True
            yield

    def has(self, cb3: tuple[int, int] | None, e: tuple[int, int] | None) -> bool:
        """Return whether the script has a feature, given the first software versions with it."""
        return self.machine.series.at_least(cb3, e)

    def _command(self) -> int:
        command = self.registers.integer(0)
        if command == NO_COMMAND:
            command, self.internal = self.internal, NO_COMMAND
        return command

    def _carry_out(self, command: int) -> Steps:
        handler = HANDLERS.get(command)
        steps = handler(self) if handler is not None else None
        if steps is not None:
            yield from steps

    def _signal(self, state: int) -> None:
        self.registers.put_integer(0, state)


def stop_move(script: ControlScript) -> None:
    """End the asynchronous move, if any; the caller must stop the arm."""
    if script.runs(MOVE):
        script.kill(MOVE)
        script.operation.finish()


def _movej(script: ControlScript) -> Steps:
    return _move(script, "j", script.registers.doubles(0), is_pose=False)


def _move(
    script: ControlScript, kind: Literal["j", "l"], target: FloatArray, *, is_pose: bool
) -> Steps:
    v, a = script.registers.doubles(6, 2).tolist()
    script.waypoint = target if is_pose else pose_at(script.machine, target)
    leg = Leg(kind, target, v, a, is_pose=is_pose)
    return _now_or_later(script, lambda: follow(script, [leg]))


MOVE, STOP = "move", "stop"
"""Names of threads."""


def _now_or_later(script: ControlScript, move: Callable[[], Steps]) -> Steps:
    """Execute a move until its end, or start it in a thread if the command is asynchronous."""
    stop_move(script)
    if script.registers.integer(1) == 1:
        script.run(MOVE, _operation(script, move))
    else:
        yield from move()


def _operation(script: ControlScript, what: Callable[[], Steps]) -> Steps:
    script.operation.start()
    yield from what()
    script.operation.finish()


def _movej_ik(script: ControlScript) -> Steps:
    """Move to a pose; the joint angles are computed now, even if the move begins later."""
    q = joints_of(script.machine, script.registers.doubles(0))
    return _move(script, "j", q, is_pose=False)


def _movel(script: ControlScript) -> Steps:
    return _move(script, "l", script.registers.doubles(0), is_pose=True)


def _movel_fk(script: ControlScript) -> Steps:
    return _move(script, "l", script.registers.doubles(0), is_pose=False)


def _stop(script: ControlScript) -> Steps:
    """Execute stopJ or stopL; the kind of stop depends on the present move."""
    deceleration = script.registers.double(0)
    if script.runs(STOP):
        script.kill(STOP)
        script.operation.finish()
    else:
        stop_move(script)
    if script.registers.integer(1) == 1:
        script.stop_linear = True
        script.run(STOP, _operation(script, lambda: stop_line(script, deceleration)))
    elif script.stop_linear:
        yield from stop_line(script, deceleration)
    else:
        yield from stop_joints(script, deceleration)


def _move_path(script: ControlScript) -> Steps:
    legs, marks = [leg for _, leg in script.path], [mark for mark, _ in script.path]

    def reached(index: int) -> None:
        leg = legs[index]
        script.waypoint = leg.target if leg.is_pose else pose_at(script.machine, leg.target)
        for mark in marks[index]:
            script.operation.progress(mark)

    return _now_or_later(script, lambda: follow(script, legs, reached))


MOVES: dict[int, Callable[[ControlScript], Steps | None]] = {
    1: _movej,
    2: _movej_ik,
    3: _movel,
    4: _movel_fk,
    33: _stop,
    34: _stop,
    45: _move_path,
}


def _step_time(script: ControlScript) -> None:
    if script.has(None, (5, 4)):
        script.registers.put_doubles(0, [script.machine.tick_s])


def _target_waypoint(script: ControlScript) -> None:
    if script.has(None, (5, 3)):
        machine = script.machine
        standing = pose_at(machine, machine.setpoint[0])
        script.registers.put_doubles(0, standing if script.waypoint is None else script.waypoint)


def _inverse_kin_near(script: ControlScript) -> None:
    script.registers.put_doubles(0, _solution_near(script))


def _solution_near(script: ControlScript) -> FloatArray:
    r = script.registers
    errors = (abs(r.double(12)), abs(r.double(13)))
    return joints_of(script.machine, r.doubles(0), r.doubles(6), errors)


def _is_pose_safe(script: ControlScript) -> None:
    script.registers.put_integer(1, _reachable(lambda: _solution(script)))


def _reachable(find: Callable[[], FloatArray]) -> bool:
    try:
        find()
    except CommandRefused:
        return False
    return True


def _solution(script: ControlScript) -> FloatArray:
    return joints_of(script.machine, script.registers.doubles(0))


def _are_joints_safe(script: ControlScript) -> None:
    safe = within_limits(script.machine, script.registers.doubles(0))
    script.registers.put_integer(1, safe)


def _joint_torques(script: ControlScript) -> None:
    script.registers.put_doubles(0, joint_torques(script.machine))


def _pose_trans(script: ControlScript) -> None:
    r = script.registers
    r.put_doubles(0, pose_trans(r.doubles(0), r.doubles(6)))


def _tcp_offset(script: ControlScript) -> None:
    if script.has((3, 6), (5, 0)):
        script.registers.put_doubles(0, script.machine.tcp)


def _forward_kin(script: ControlScript) -> None:
    machine = script.machine
    script.registers.put_doubles(0, pose_at(machine, machine.reading.q))


def _forward_kin_of(script: ControlScript) -> None:
    q, tcp = script.registers.doubles(0), script.registers.doubles(6)
    script.registers.put_doubles(0, pose_of(script.machine.body.arm, q, tcp))


def _inverse_kin(script: ControlScript) -> None:
    script.registers.put_doubles(0, _solution(script))


def _is_steady(script: ControlScript) -> None:
    script.registers.put_integer(1, is_steady(script.machine))


def _flange_pose(script: ControlScript) -> None:
    machine = script.machine
    pose = pose_of(machine.body.arm, machine.reading.q, np.zeros(6))
    script.registers.put_doubles(0, pose)


def _has_solution(script: ControlScript) -> None:
    if script.has((3, 15), (5, 10)):
        script.registers.put_integer(1, _reachable(lambda: _solution(script)))


def _has_solution_near(script: ControlScript) -> None:
    if script.has((3, 15), (5, 10)):
        script.registers.put_integer(1, _reachable(lambda: _solution_near(script)))


def _mass_matrix(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        _put_matrix(script, machine.body.mass_matrix(machine.reading.q))


UPPER_COLUMNS = 36
"""Number of the first register for columns 4 and 5 of a matrix; columns 0 to 3 begin at register
0."""


def _put_matrix(script: ControlScript, matrix: FloatArray) -> None:
    """Write a matrix (6, 6) into the registers, column by column."""
    columns = np.asarray(matrix).T.ravel()
    script.registers.put_doubles(0, columns[:24])
    script.registers.put_doubles(UPPER_COLUMNS, columns[24:])


def _coriolis(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        body, seen = script.machine.body, script.machine.reading
        still = np.zeros(6)
        moving = body.torque_for(seen.q, seen.qd, still)
        script.registers.put_doubles(0, moving - body.torque_for(seen.q, still, still))


def _target_accelerations(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        script.registers.put_doubles(0, script.machine.setpoint[2])


def _jacobian(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        _put_matrix(script, jacobian(machine.body.arm, machine.reading.q, machine.tcp))


JACOBIAN_STEP_S = 1e-6


def _jacobian_rate(script: ControlScript) -> None:
    if script.has(None, (5, 23)):
        machine = script.machine
        arm, q, qd = machine.body.arm, machine.reading.q, machine.reading.qd
        ahead, behind = (
            np.asarray(jacobian(arm, q + sign * JACOBIAN_STEP_S * qd, machine.tcp))
            for sign in (1, -1)
        )
        _put_matrix(script, (ahead - behind) / (2 * JACOBIAN_STEP_S))


QUERIES: dict[int, Callable[[ControlScript], Steps | None]] = {
    26: _step_time,
    28: _target_waypoint,
    30: _inverse_kin_near,
    36: _is_pose_safe,
    37: _are_joints_safe,
    38: _joint_torques,
    39: _pose_trans,
    40: _tcp_offset,
    43: _forward_kin,
    44: _forward_kin_of,
    46: _inverse_kin,
    47: _is_steady,
    58: _flange_pose,
    60: _has_solution,
    61: _has_solution_near,
    67: _mass_matrix,
    68: _coriolis,
    69: _target_accelerations,
    70: _jacobian,
    71: _jacobian_rate,
}


def _nothing(script: ControlScript) -> None:
    """Accept a command without effect, because the mock lacks the sensor or the setting."""


def _set_payload(script: ControlScript) -> None:
    """Declare a payload; on e-Series, a centre of mass of zeros keeps the present value."""
    mass, *com = script.registers.doubles(0, 4).tolist()
    keep = script.has(None, (5, 0)) and not any(com)
    set_payload(script.machine, mass, None if keep else com)


def _teach_mode(script: ControlScript) -> None:
    script.hand_guided = True


def _end_teach_mode(script: ControlScript) -> None:
    script.hand_guided = False


def _set_tcp(script: ControlScript) -> None:
    set_tcp(script.machine, script.registers.doubles(0).tolist())


PROTECTIVE_STOP_BY_PROGRAM = 0


def _protective_stop(script: ControlScript) -> Steps:
    """Trigger a protective stop and pause, so the client detects the stop before completion."""
    if script.has((3, 8), (5, 0)):
        script.machine.protective_stop(PROTECTIVE_STOP_BY_PROGRAM)
        yield


def _set_watchdog(script: ControlScript) -> None:
    variable = f"input_int_register_{script.registers.offset}"
    set_watchdog(script.machine, variable, script.registers.double(0), "stop")


def _freedrive_mode(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.hand_guided = True


def _end_freedrive_mode(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.hand_guided = False


FREEDRIVE_NORMAL = 0


def _freedrive_status(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.registers.put_integer(1, FREEDRIVE_NORMAL)


def _set_target_payload(script: ControlScript) -> None:
    """Declare a payload with inertia; the command has no effect before 5.10 and on CB3."""
    if script.has(None, (5, 10)):
        mass, *rest = script.registers.doubles(0, 10).tolist()
        com = rest[:3] if any(rest[:3]) else None
        set_payload(script.machine, mass, com, rest[3:])


SETTINGS: dict[int, Callable[[ControlScript], Steps | None]] = {
    8: _nothing,  # zero_ftsensor
    17: _set_payload,
    18: _teach_mode,
    19: _end_teach_mode,
    20: _nothing,  # force_mode_set_damping
    21: _nothing,  # force_mode_set_gain_scaling
    29: _set_tcp,
    31: _protective_stop,
    35: _set_watchdog,
    52: _freedrive_mode,
    53: _end_freedrive_mode,
    54: _freedrive_status,
    56: _nothing,  # ft_rtde_input_enable
    57: _nothing,  # enable_external_ft_sensor
    59: _nothing,  # set_gravity
    65: _set_target_payload,
}


def _force_mode(script: ControlScript) -> None:
    """Accept a force-mode command; the arm is not compliant (docs/reference/mock-ur-control.md)."""
    script.registers.doubles(0, 18)


FORCE_STOP_M_S2, JOG_STOP_M_S2 = 10.0, 1.2


def _force_mode_stop(script: ControlScript) -> Steps:
    return stop_line(script, FORCE_STOP_M_S2)


def _speedj(script: ControlScript) -> None:
    _speed(script, linear=False)


SERVO, SPEED, JOG = "servo", "speed", "jog"
"""Names of threads."""


def _speed(script: ControlScript, *, linear: bool) -> None:
    """Set a speed that continues until it is changed; the script ignores the time in register 7."""
    script.speed = (linear, script.registers.doubles(0), abs(script.registers.double(6)))
    if not script.runs(SPEED):
        script.run(SPEED, _keep_speed(script, lambda: script.speed))


def _keep_speed(
    script: ControlScript, wanted: Callable[[], tuple[bool, FloatArray, float]]
) -> Steps:
    machine = script.machine
    motion: SpeedJ | SpeedL | None = None
    with script.control():
        while True:
            linear, speed, acceleration = wanted()
            kind = SpeedL if linear else SpeedJ
            if motion is None or machine.motion is not motion or not isinstance(motion, kind):
                motion = speed_motion(machine, linear=linear)
                machine.move(motion)
            motion.aim(speed, acceleration)
            yield


def _speedl(script: ControlScript) -> None:
    _speed(script, linear=True)


def _servoj(script: ControlScript) -> None:
    _servo_to(script, script.registers.doubles(0))


def _servo_to(script: ControlScript, q: FloatArray) -> None:
    """Set the servo target; like the script, ignore registers 6 and 7 (speed, acceleration)."""
    script.servo = (q, *script.registers.doubles(8, 3).tolist())
    if not script.runs(SERVO):
        script.run(SERVO, _servo(script))


def _servo(script: ControlScript) -> Steps:
    machine = script.machine
    with script.control():
        motion = ServoJ(machine.tick_s, machine.body.arm)
        while True:
            if machine.motion is not motion:
                motion = ServoJ(machine.tick_s, machine.body.arm)
                machine.move(motion)
            motion.aim(*script.servo)
            yield


def _speed_stop(script: ControlScript) -> Steps:
    script.kill(SPEED)
    stop = stop_line if script.speed[0] else stop_joints
    return stop(script, script.registers.double(0))


def _servo_stop(script: ControlScript) -> Steps:
    script.kill(SERVO)
    return stop_line(script, script.registers.double(0))


def _servol(script: ControlScript) -> None:
    _servo_to(script, joints_of(script.machine, script.registers.doubles(0)))


def _jog_start(script: ControlScript) -> None:
    feature, acceleration = script.registers.doubles(6, 2)
    script.jog = (True, _in_base(script, int(feature)), abs(acceleration))
    if not script.runs(JOG):
        script.run(JOG, _keep_speed(script, lambda: script.jog))


TOOL, CUSTOM = 1, 2
"""Numbers of the frames for jogging; any other number selects the base frame."""


def _in_base(script: ControlScript, feature: int) -> FloatArray:
    """Return a speed (6,) in the axes of the base, from a speed in the axes of a jogging frame."""
    machine, speed = script.machine, script.registers.doubles(0)
    if feature not in (TOOL, CUSTOM):
        return speed
    tool = pose_at(machine, machine.reading.q)
    frame = frame_of(tool if feature == TOOL else script.registers.doubles(8))
    return np.array((*turned(frame, *speed[:3]), *turned(frame, *speed[3:])))


def _jog_stop(script: ControlScript) -> Steps:
    script.kill(JOG)
    return stop_line(script, JOG_STOP_M_S2)


STREAMS: dict[int, Callable[[ControlScript], Steps | None]] = {
    6: _force_mode,
    7: _force_mode_stop,
    9: _speedj,
    10: _speedl,
    11: _servoj,
    15: _speed_stop,
    16: _servo_stop,
    24: _servol,
    41: _jog_start,
    42: _jog_stop,
}


def _tool_contact(script: ControlScript) -> None:
    direction = script.registers.doubles(0)
    if script.has(*SINCE):
        script.registers.put_integer(1, script.touch.along(direction))


def _history(script: ControlScript) -> None:
    if script.has(*SINCE):
        script.registers.put_doubles(0, _past(script, script.registers.integer(1)))


def _past(script: ControlScript, ticks: int) -> FloatArray:
    q = script.touch.past(ticks)
    if q is None:
        raise CommandRefused(
            f"get_actual_joint_positions_history: fewer than {ticks} steps are stored"
        )
    return q


def _move_until_contact(script: ControlScript) -> Steps | None:
    if not script.has(*SINCE):
        return None
    r = script.registers
    return _until_contact(script, r.doubles(0), r.doubles(6), r.double(12))


def _until_contact(
    script: ControlScript, speed: FloatArray, direction: FloatArray, acceleration: float
) -> Steps:
    machine = script.machine
    motion: SpeedL | None = None
    with script.control():
        while not (ticks := script.touch.along(direction)):
            if motion is None or machine.motion is not motion:
                motion = SpeedL(machine.body.arm, machine.tcp, machine.tick_s)
                machine.move(motion)
            motion.aim(speed, acceleration)
            yield
        yield from _back_to_contact(script, ticks)


STOP_M_S2, BACK_M_S, BACK_M_S2 = 3.0, 0.25, 1.2
"""Deceleration at a contact, and speed and acceleration of URScript's return move [m/s², m/s,
m/s²].
"""


def _back_to_contact(script: ControlScript, ticks: int) -> Steps:
    q = _past(script, ticks)
    yield from stop_line(script, STOP_M_S2)
    yield from follow(script, [Leg("l", q, BACK_M_S, BACK_M_S2)])


CONTACT = "contact"
"""Name of a thread."""


def _start_detection(script: ControlScript) -> None:
    script.kill(CONTACT)
    script.run(CONTACT, _detect(script, script.registers.doubles(0)))


CONTACT_SEEN = 254


def _detect(script: ControlScript, direction: FloatArray) -> Steps:
    """Wait until no contact exists, then until a contact occurs.

    On CB3, the script reports a contact immediately.
    """
    script.contact = 0
    if not script.has(*SINCE):
        script.contact, script.internal = 1, CONTACT_SEEN
        return
    while script.touch.along(_way(script, direction)):
        yield
    while not (ticks := script.touch.along(_way(script, direction))):
        yield
    script.contact, script.internal = ticks, CONTACT_SEEN


def _way(script: ControlScript, direction: FloatArray) -> FloatArray:
    """Return the direction for contact detection; a sum of zero selects the TCP velocity."""
    if direction.sum() >= 1e-10:
        return direction
    machine = script.machine
    q, qd, _ = machine.setpoint
    return tool_velocity(machine.body.arm, q, qd, machine.tcp)


def _stop_detection(script: ControlScript) -> None:
    script.kill(CONTACT)
    script.registers.put_integer(1, script.contact)


def _read_detection(script: ControlScript) -> None:
    script.registers.put_integer(1, script.contact)


def _contact_seen(script: ControlScript) -> Steps | None:
    if not script.has(*SINCE):
        return None
    stop_move(script)
    return _back_to_contact(script, script.contact)


TOUCHES: dict[int, Callable[[ControlScript], Steps | None]] = {
    25: _tool_contact,
    27: _history,
    51: _move_until_contact,
    62: _start_detection,
    63: _stop_detection,
    64: _read_detection,
    CONTACT_SEEN: _contact_seen,
}

HANDLERS: dict[int, Callable[[ControlScript], Steps | None]] = {
    **MOVES,
    **QUERIES,
    **SETTINGS,
    **STREAMS,
    **TOUCHES,
}
