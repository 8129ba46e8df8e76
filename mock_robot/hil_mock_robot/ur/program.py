"""Building blocks of robot programs, for scripts and for the control script of `ur-rtde`.

`Threaded` runs the threads of a program, one step per tick; only one thread at a time moves the
arm. The other functions are steps of a thread: moves and stops until they are over (`follow`,
`stop_joints`), settings with the checks of the controller (`set_payload`, `set_tcp`,
`set_watchdog`), `Registers` shared with clients, the register that reports an asynchronous
`Operation`, and contacts (`Touch`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.kinematics import Numbers, jacobian, pose_of, solve
from hil_mock_robot.ur.machine import PROGRAM_STOP_RAD_S2, Machine, Watchdog
from hil_mock_robot.ur.motion import Motion, MovePath, SpeedJ, SpeedL, StopJoints, StopL
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_errors import place_of

Steps = Generator[None, None, None]
"""Thread of a program: a generator that yields when URScript waits for the next tick."""

M = TypeVar("M", bound=Motion)
MAIN = "main"
ANOTHER_THREAD = "Another thread is already controlling the robot"
IMPATIENT = "a secondary program takes no time: it cannot wait or move"
HAND_GUIDED = "The robot cannot move by itself while it is guided by hand"


class Threaded:
    """`Program` that consists of threads; the first thread is the generator `main`.

    Args:
        name: Name in the `def` of the program.
        patient: Whether the program can wait for ticks and move; false for a secondary program.

    Attributes:
        machine: Controller that plays the program; set by `begin`.
        hand_guided: Whether the arm can be moved by hand, which prevents programmed motions.
    """

    machine: Machine

    def __init__(self, name: str, *, patient: bool = True) -> None:
        self.name, self.patient = name, patient
        self.hand_guided = False
        self._threads: dict[str, Steps] = {}
        self._turn = self._controlling = ""
        self._ticked = -1
        self._resumed = False

    def main(self) -> Steps:
        """Run the first thread; the program is over when this thread ends."""
        raise NotImplementedError

    def begin(self, machine: Machine) -> None:
        """See `Program`."""
        self.machine = machine
        self.run(MAIN, self.main())

    def tick(self, machine: Machine) -> bool:
        """Run one step of every thread; threads started in a tick run their first step in it."""
        self._resumed = self._ticked >= 0 and machine.ticks - self._ticked > 1
        self._ticked = machine.ticks
        served: set[str] = set()
        try:
            while waiting := [name for name in self._threads if name not in served]:
                served.add(waiting[0])
                self._step(waiting[0])
        except CommandRefused as error:
            machine.fail(error.message, place=place_of(error))
        return MAIN in self._threads

    def end(self, machine: Machine) -> None:
        """See `Program`."""
        while self._threads:
            self._threads.popitem()[1].close()
        self._controlling = ""

    def run_at_once(self, machine: Machine) -> None:
        """Run the program up to its first wait, beside the playing program.

        Raises:
            CommandRefused: The program raised a runtime error.
        """
        self.begin(machine)
        try:
            self._step(MAIN)
        finally:
            self.end(machine)

    def run(self, name: str, steps: Steps) -> None:
        """Start a thread under a name."""
        self._threads[name] = steps

    def runs(self, name: str) -> bool:
        """Return whether a thread with a name runs."""
        return name in self._threads

    def kill(self, name: str) -> None:
        """End a thread, if it runs; a motion of this thread comes to rest."""
        thread = self._threads.pop(name, None)
        if thread is not None:
            moving = self._controlling == name
            thread.close()
            if moving:
                self.machine.move(self._stop())

    @contextmanager
    def control(self) -> Iterator[None]:
        """Reserve the control of the arm for the present thread inside the block.

        Raises:
            CommandRefused: Another thread controls the arm, the arm is guided by hand, or the
                program is a secondary program.
        """
        if not self.patient:
            raise CommandRefused(IMPATIENT)
        me = self._turn
        if self._controlling not in ("", me):
            raise CommandRefused(ANOTHER_THREAD)
        if self.hand_guided:
            raise CommandRefused(HAND_GUIDED)
        outermost, self._controlling = self._controlling != me, me
        try:
            yield
        finally:
            if outermost and self._controlling == me:
                self._controlling = ""

    def drive(
        self,
        make: Callable[[], M],
        *,
        watch: Callable[[M], None] = lambda _: None,
    ) -> Steps:
        """Move the arm until the motion is over.

        Args:
            make: Constructor of the motion; called again after a pause, which stops the motion.
            watch: Function called with the motion in every tick.
        """
        with self.control():
            again = True
            while again:
                motion = make()
                self.machine.move(motion)
                watch(motion)
                yield
                while self.machine.motion is motion:
                    watch(motion)
                    yield
                again = self._resumed

    def _stop(self) -> StopJoints:
        return StopJoints(PROGRAM_STOP_RAD_S2, self.machine.tick_s)

    def _step(self, name: str) -> None:
        self._turn = name
        try:
            next(self._threads[name])
        except StopIteration:
            self._threads.pop(name, None)


def follow(
    program: Threaded, legs: Sequence[Leg], reached: Callable[[int], None] = lambda _: None
) -> Steps:
    """Move along a path until its end; after a pause, continue with the interrupted move.

    Args:
        program: Program that moves the arm.
        legs: Moves of the path.
        reached: Function called with the index of each move when it begins; a blend belongs to the
            later move.
    """
    machine, begun, first = program.machine, -1, 0

    def make() -> MovePath:
        nonlocal first
        first = max(begun, 0)
        return MovePath(machine.body.arm, machine.tcp, legs[first:], machine.tick_s)

    def note(index: int) -> None:
        nonlocal begun
        while begun < index:
            begun += 1
            reached(begun)

    if legs:
        yield from program.drive(make, watch=lambda motion: note(first + motion.progress))
        note(len(legs) - 1)


LEAST_STOP = 1e-3
"""Minimum deceleration of a stop, so that every stop ends [m/s² or rad/s²]."""

FARTHEST = 1e3
"""Magnitude [m or rad] beyond which a pose is refused without a search."""

STEADY_RAD_S = 1e-3
NO_SOLUTION = "get_inverse_kin: unable to find an inverse kinematics solution"


def joints_of(
    machine: Machine,
    pose: FloatArray,
    near: FloatArray | None = None,
    errors: tuple[float, float] = (1e-9, 1e-9),
) -> FloatArray:
    """Return the joint angles (6,) of a TCP pose, nearest to `near` or to the present set-point.

    Args:
        machine: Controller with arm and TCP.
        pose: Target pose of the TCP, (6,).
        near: Reference joint angles, (6,) [rad].
        errors: Maximum position [m] and orientation error [rad].

    Raises:
        CommandRefused: The arm cannot reach the pose.
    """
    start = machine.setpoint[0] if near is None else near
    if max(np.abs(pose).max(), np.abs(start).max()) > FARTHEST:
        raise CommandRefused(NO_SOLUTION)
    position_m, orientation_rad = errors
    q = solve(
        machine.body.arm, pose, start, machine.tcp,
        position_m=position_m, orientation_rad=orientation_rad,
    )  # fmt: skip
    if q is None:
        raise CommandRefused(NO_SOLUTION)
    return q


def within_limits(machine: Machine, q: Sequence[float] | FloatArray) -> bool:
    """Return whether the joint angles are within the joint limits."""
    arm = machine.body.arm
    return bool(((arm.q_min <= q) & (q <= arm.q_max)).all())


def pose_at(machine: Machine, q: Numbers) -> FloatArray:
    """Return the TCP pose (6,) at joint angles (6,)."""
    return pose_of(machine.body.arm, q, machine.tcp)


def speed_motion(machine: Machine, *, linear: bool) -> SpeedJ | SpeedL:
    """Return a motion with constant TCP velocity (`linear`) or constant joint speeds."""
    if linear:
        return SpeedL(machine.body.arm, machine.tcp, machine.tick_s)
    return SpeedJ(machine.tick_s, machine.body.arm)


def stop_joints(program: Threaded, deceleration: float) -> Steps:
    """Stop the joints as in URScript `stopj`, until the arm is at rest."""
    rate = max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopJoints(rate, program.machine.tick_s))


def stop_line(program: Threaded, deceleration: float) -> Steps:
    """Stop the tool as in URScript `stopl`, until the arm is at rest."""
    machine, rate = program.machine, max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopL(machine.body.arm, machine.tcp, rate, machine.tick_s))


def joint_torques(machine: Machine) -> FloatArray:
    """Return the motor torque (6,) that the controller's model does not explain [N·m]."""
    beyond = machine.reading.current - machine.reading.current_target
    return np.nan_to_num(machine.body.arm.drive_gains * beyond)


def is_steady(machine: Machine) -> bool:
    """Return whether the commanded and the true joint speeds are zero, within `STEADY_RAD_S`."""
    commanded = bool(machine.setpoint[1].any())
    return not commanded and bool(np.abs(machine.reading.true_qd).max() < STEADY_RAD_S)


HEAVIEST = 2.0
"""Maximum accepted payload, as a multiple of the rated payload."""

FARTHEST_M = 4.0
LEAST_KG = 1e-6

LEAST_INERTIA, LARGEST_INERTIA = 1e-9, 133.0
"""Tolerance and maximum of moments of inertia [kg·m²]; the maximum is that of the URScript
manual.
"""

ACTIONS = ("ignore", "pause", "stop")

LEAST_PER_TICK = 1e-9
"""Minimum frequency of a watchdog, in writes per tick; a watchdog with this frequency practically
never expires."""


def set_payload(
    machine: Machine,
    mass: float,
    com: Sequence[float] | None = None,
    inertia: Sequence[float] | None = None,
) -> None:
    """Declare a payload.

    Args:
        machine: Controller to which the payload is declared.
        mass: Mass [kg].
        com: Centre of mass in the flange frame, (3,) [m]; None for the present centre of mass.
        inertia: Inertia about the centre of mass, (6,) [kg·m²]; None for zero.

    Raises:
        CommandRefused: Mass, centre of mass or inertia is out of range.
    """
    if not 0 <= mass <= HEAVIEST * machine.body.arm.payload_max_kg:
        raise CommandRefused(f"set_payload: mass {mass:g} kg is out of range")
    x, y, z = machine.body.declared.com if com is None else com
    if not max(abs(x), abs(y), abs(z)) <= FARTHEST_M:
        raise CommandRefused(f"set_payload: centre of gravity ({x:g}, {y:g}, {z:g}) m out of range")
    payload = Payload(mass if mass >= LEAST_KG else 0.0, (x, y, z), _inertia(inertia or [0.0] * 6))
    if payload != machine.body.declared:
        machine.body.declare(payload)


def _inertia(values: Sequence[float]) -> tuple[float, float, float, float, float, float]:
    """Return the inertia if it is physically consistent.

    Raises:
        CommandRefused: A principal moment is negative, above the sum of the other two, or above
            `LARGEST_INERTIA`.
    """
    xx, yy, zz, xy, xz, yz = values
    small, middle, large = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if small < -LEAST_INERTIA or large > small + middle + LEAST_INERTIA or large > LARGEST_INERTIA:
        raise CommandRefused("set_target_payload: no rigid body has such moments of inertia")
    return xx, yy, zz, xy, xz, yz


def set_tcp(machine: Machine, pose: Sequence[float]) -> None:
    """Set the tool centre point, (6,) in the flange frame.

    Raises:
        CommandRefused: The pose does not consist of six finite numbers.
    """
    if len(pose) != 6 or not all(map(math.isfinite, pose)):
        raise CommandRefused("set_tcp: a pose of six numbers is needed")
    machine.tcp = np.array(pose, dtype=float)


def set_watchdog(machine: Machine, variable: str, least_hz: float, action: str) -> None:
    """Set the watchdog of URScript `rtde_set_watchdog`, starting now; frequency 0 removes it.

    Args:
        machine: Controller whose program is monitored.
        variable: Input that must be written.
        least_hz: Minimum write frequency [Hz].
        action: One of `ACTIONS` in lower or upper case; UR's example uses upper case.

    Raises:
        CommandRefused: The input or the action does not exist, or the frequency is not finite.
    """
    action = action.lower()
    if variable not in machine.inputs or action not in ACTIONS:
        raise CommandRefused(f"rtde_set_watchdog: no input {variable!r}, or no action {action!r}")
    if not math.isfinite(least_hz):
        raise CommandRefused(f"rtde_set_watchdog: {least_hz} is not a frequency")
    if least_hz <= 0 or action == "ignore":
        machine.watchdog = None
        return
    ticks = math.ceil(1.0 / max(least_hz * machine.tick_s, LEAST_PER_TICK) - 1e-9)
    machine.written[variable] = machine.ticks
    machine.watchdog = Watchdog(variable, max(1, ticks), action)


INT32 = 2**31

LARGEST = 1e9
"""Maximum magnitude of a pose coordinate, speed or force in a register; larger numbers only
cause overflow."""


class Registers:
    """Input registers to read and output registers to write, from number `offset` on.

    Args:
        machine: Controller with the registers.
        offset: First register: 0, or 24 for the upper range.

    Raises:
        CommandRefused: The simulated software has no upper range of registers.
    """

    def __init__(self, machine: Machine, offset: int = 0) -> None:
        self.offset = offset
        self._in, self._out = machine.inputs, machine.outputs
        starts = [f"input_int_register_{offset}", f"output_int_register_{offset}"]
        if any(
            name not in values for name, values in zip(starts, (self._in, self._out), strict=True)
        ):
            raise CommandRefused(f"there is no register {offset} in this software")
        self._ints = self._in.variables[f"input_int_register_{offset}"].offset
        self._doubles = self._in.variables[f"input_double_register_{offset}"].offset

    def integer(self, number: int) -> int:
        """Return an integer that a client has written."""
        return int(self._in.flat[self._ints + number])

    def double(self, number: int) -> float:
        """Return a number that a client has written.

        Raises:
            CommandRefused: The magnitude is above `LARGEST`, or the value is NaN.
        """
        value = float(self._in.flat[self._doubles + number])
        if not abs(value) <= LARGEST:
            raise CommandRefused(f"input double register {self.offset + number} is {value}")
        return value

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        """Return `count` consecutive numbers that a client has written; see `double`."""
        return np.array([self.double(first + i) for i in range(count)])

    def put_integer(self, number: int, value: int) -> None:
        """Write an output integer register.

        Raises:
            CommandRefused: The register does not exist, or the value exceeds 32 bits.
        """
        name = f"output_int_register_{self.offset + number}"
        if name not in self._out or not -INT32 <= value < INT32:
            raise CommandRefused(f"cannot write {value} to {name}")
        self._out[name] = int(value)

    def put_doubles(self, first: int, values: Iterable[float]) -> None:
        """Write consecutive output double registers.

        Raises:
            CommandRefused: A register does not exist.
        """
        for number, value in enumerate(values, self.offset + first):
            name = f"output_double_register_{number}"
            if name not in self._out:
                raise CommandRefused(f"there is no {name}")
            self._out[name] = float(value)


WORD, LARGEST_COUNT, MOST_PROGRESS = 2, 127, 0x7FFF
RUNNING = 1 << 15


class Operation:
    """State of an asynchronous operation, reported in one integer register.

    Bits 0–14 contain the progress, bit 15 the running flag, bits 16–23 the count of changes, and
    bits 24–30 the number of the operation.

    Args:
        registers: Registers of the program; the state is written to output integer register 2.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._changes = self._number = 0
        self.finish()

    def start(self) -> None:
        """Report the start of a new operation."""
        self.progress(0)

    def progress(self, value: int) -> None:
        """Report the progress `value`; as in the script, the value 0 counts as a new operation."""
        if value == 0:
            self._number = (self._number + 1) % (LARGEST_COUNT + 1)
        self._tell(RUNNING + min(value, MOST_PROGRESS))

    def finish(self) -> None:
        """Report that no operation is running."""
        self._tell(0)

    def _tell(self, rest: int) -> None:
        self._changes = (self._changes + 1) % (LARGEST_COUNT + 1)
        self._registers.put_integer(WORD, self._number << 24 | self._changes << 16 | rest)


SINCE = (None, (5, 4))
"""First software with contact detection and joint position history: none on CB3, 5.4 on
e-Series.
"""

LEAST_FORCE_N = 10.0
REMEMBERED_S = 2.0


class Touch:
    """Contact detector, called once per tick; older software (`SINCE`) never detects a contact.

    Attributes:
        force: External force on the tool in the base frame, (3,) [N]; None if there is no force.
        ticks: Number of ticks since the force began.
    """

    def __init__(self) -> None:
        self.force: FloatArray | None = None
        self.ticks = 0
        self._past: deque[FloatArray] = deque()

    def look(self, machine: Machine) -> None:
        """Record joint positions and the external force of this tick."""
        if not machine.series.at_least(*SINCE):
            return
        self._past.append(machine.reading.q)
        if len(self._past) > REMEMBERED_S / machine.tick_s:
            self._past.popleft()
        self.force = _force_of(machine)
        self.ticks = self.ticks + 1 if self.force is not None else 0

    def along(self, direction: FloatArray) -> int:
        """Return the ticks since a force opposes the motion of the tool.

        The returned number is 0 if there is no such force.

        Args:
            direction: Direction of motion, (6,), of which only the translation counts; zero for any
                direction.
        """
        if self.force is None or (direction[:3].any() and direction[:3] @ self.force >= 0):
            return 0
        return min(self.ticks, len(self._past) - 1)

    def past(self, ticks: int) -> FloatArray | None:
        """Return the joint angles (6,) of `ticks` ticks ago [rad]; None if they are not stored."""
        if not 0 <= ticks < len(self._past):
            return None
        return self._past[-1 - ticks]


def _force_of(machine: Machine) -> FloatArray | None:
    push = machine.body.pushed
    if not push.any():
        return None
    columns = np.asarray(jacobian(machine.body.arm, machine.reading.q, machine.tcp))
    wrench, *_ = np.linalg.lstsq(columns.T, push, rcond=1e-3)
    force = np.asarray(wrench[:3], dtype=np.float64)
    return force if np.linalg.norm(force) >= LEAST_FORCE_N else None
