"""Robot programs: what they are made of, whether a script or the control script of `ur-rtde`.

`Threaded` runs the threads of a program, one step a tick, of which one at a time moves the arm. The
rest is what its steps call: moves and stops until they are over (`follow`, `stop_joints`), settings
with the controller's own checks (`set_payload`, `set_tcp`, `set_watchdog`), `Registers` shared with
clients, the word that reports an asynchronous `Operation`, and contacts (`Touch`).
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
"""A thread of a program: it yields where URScript waits for the next tick."""

M = TypeVar("M", bound=Motion)
MAIN = "main"
ANOTHER_THREAD = "Another thread is already controlling the robot"
IMPATIENT = "a secondary program takes no time: it cannot wait or move"
HAND_GUIDED = "The robot cannot move by itself while it is guided by hand"


class Threaded:
    """A `Program` of threads; the first one is the generator `main`.

    Args:
        name: What its `def` calls it.
        patient: Whether it may wait for ticks and move; a secondary program may not.

    Attributes:
        machine: Known from `begin` on.
        hand_guided: Whether people may push the arm around, which keeps it from moving itself.
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
        """The first thread; the program is over when it is."""
        raise NotImplementedError

    def begin(self, machine: Machine) -> None:
        """See `Program`."""
        self.machine = machine
        self.run(MAIN, self.main())

    def tick(self, machine: Machine) -> bool:
        """See `Program`; threads that are started in a tick have their first turn in it."""
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
        """Run the program up to its first wait, beside the one that plays.

        Raises:
            CommandRefused: A runtime error.
        """
        self.begin(machine)
        try:
            self._step(MAIN)
        finally:
            self.end(machine)

    def run(self, name: str, steps: Steps) -> None:
        """Start a thread."""
        self._threads[name] = steps

    def runs(self, name: str) -> bool:
        """Whether there is such a thread."""
        return name in self._threads

    def kill(self, name: str) -> None:
        """End a thread, if it runs; its motion comes to rest unless another thread goes on."""
        thread = self._threads.pop(name, None)
        if thread is not None:
            moving = self._controlling == name
            thread.close()
            if moving:
                self.machine.move(self._stop())

    @contextmanager
    def control(self) -> Iterator[None]:
        """Be the thread that moves the arm.

        Raises:
            CommandRefused: Another thread is, the arm is guided by hand, or nothing may move it.
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
            make: The motion; called again after a pause, which had stopped it.
            watch: Called in every tick.
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
    """Move along a path until its end; a pause is gone on from with the move it fell into.

    Args:
        program: Whose.
        legs: Its moves.
        reached: Called with the index of each move as it begins; blends belong to the later one.
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
"""What comes to rest sooner or later, whatever deceleration was asked for."""

FARTHEST = 1e3
"""Metres and radians beyond which no pose is looked at."""

STEADY_RAD_S = 1e-3
NO_SOLUTION = "get_inverse_kin: unable to find an inverse kinematics solution"


def joints_of(
    machine: Machine,
    pose: FloatArray,
    near: FloatArray | None = None,
    errors: tuple[float, float] = (1e-9, 1e-9),
) -> FloatArray:
    """(6,) joint angles that bring the TCP to a pose, the nearest to `near` or to where it is.

    Args:
        machine: Whose arm and TCP.
        pose: (6,).
        near: (6,) [rad].
        errors: Largest position [m] and orientation error [rad].

    Raises:
        CommandRefused: The arm does not reach it.
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
    """Whether the joints may turn so far."""
    arm = machine.body.arm
    return bool(((arm.q_min <= q) & (q <= arm.q_max)).all())


def pose_at(machine: Machine, q: Numbers) -> FloatArray:
    """(6,) where the TCP is with joint angles (6,)."""
    return pose_of(machine.body.arm, q, machine.tcp)


def speed_motion(machine: Machine, *, linear: bool) -> SpeedJ | SpeedL:
    """Return a motion that keeps the joints, or the TCP, at a speed."""
    if linear:
        return SpeedL(machine.body.arm, machine.tcp, machine.tick_s)
    return SpeedJ(machine.tick_s, machine.body.arm)


def stop_joints(program: Threaded, deceleration: float) -> Steps:
    """URScript `stopj`, until the arm is at rest."""
    rate = max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopJoints(rate, program.machine.tick_s))


def stop_line(program: Threaded, deceleration: float) -> Steps:
    """URScript `stopl`, until the arm is at rest."""
    machine, rate = program.machine, max(abs(deceleration), LEAST_STOP)
    return program.drive(lambda: StopL(machine.body.arm, machine.tcp, rate, machine.tick_s))


def joint_torques(machine: Machine) -> FloatArray:
    """Return (6,) torque of the motors beyond that of the controller's model [N·m]."""
    beyond = machine.reading.current - machine.reading.current_target
    return np.nan_to_num(machine.body.arm.drive_gains * beyond)


def is_steady(machine: Machine) -> bool:
    """Whether nothing moves, nor is about to."""
    commanded = bool(machine.setpoint[1].any())
    return not commanded and bool(np.abs(machine.reading.true_qd).max() < STEADY_RAD_S)


HEAVIEST = 2.0
"""Largest payload that is taken, as a share of the rated one."""

FARTHEST_M = 4.0
LEAST_KG = 1e-6

LEAST_INERTIA, LARGEST_INERTIA = 1e-9, 133.0
"""[kg·m²]; the largest is the URScript manual's."""

ACTIONS = ("ignore", "pause", "stop")

LEAST_PER_TICK = 1e-9
"""Of a watchdog, which does not bite in anybody's lifetime then."""


def set_payload(
    machine: Machine,
    mass: float,
    com: Sequence[float] | None = None,
    inertia: Sequence[float] | None = None,
) -> None:
    """Declare a load.

    Args:
        machine: To whom.
        mass: [kg].
        com: (3,) centre of mass in the flange frame [m]; the present one when None.
        inertia: (6,) about it [kg·m²]; zero when None.

    Raises:
        CommandRefused: It cannot be.
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
    """Return an inertia that a rigid body can have: no moment above the sum of the two others."""
    xx, yy, zz, xy, xz, yz = values
    small, middle, large = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if small < -LEAST_INERTIA or large > small + middle + LEAST_INERTIA or large > LARGEST_INERTIA:
        raise CommandRefused("set_target_payload: no rigid body has such moments of inertia")
    return xx, yy, zz, xy, xz, yz


def set_tcp(machine: Machine, pose: Sequence[float]) -> None:
    """Set the tool centre point, (6,) in the flange frame.

    Raises:
        CommandRefused: It cannot be there.
    """
    if len(pose) != 6 or not all(map(math.isfinite, pose)):
        raise CommandRefused("set_tcp: a pose of six numbers is needed")
    machine.tcp = np.array(pose, dtype=float)


def set_watchdog(machine: Machine, variable: str, least_hz: float, action: str) -> None:
    """URScript `rtde_set_watchdog`, which counts from now on; a frequency of zero ends it.

    Args:
        machine: Whose program is watched.
        variable: The input that has to be written.
        least_hz: How often at least [Hz].
        action: One of `ACTIONS`, in small or capital letters: UR's own example writes capitals.

    Raises:
        CommandRefused: There is no such input, no such action, or that is no frequency.
    """
    action = action.lower()
    if variable not in machine.inputs or action not in ACTIONS:
        raise CommandRefused(f"rtde_set_watchdog: no input {variable!r}, or no action {action!r}")
    if not math.isfinite(least_hz):
        raise CommandRefused(f"rtde_set_watchdog: {least_hz} is no frequency")
    if least_hz <= 0 or action == "ignore":
        machine.watchdog = None
        return
    ticks = math.ceil(1.0 / max(least_hz * machine.tick_s, LEAST_PER_TICK) - 1e-9)
    machine.written[variable] = machine.ticks
    machine.watchdog = Watchdog(variable, max(1, ticks), action)


INT32 = 2**31

LARGEST = 1e9
"""What no pose, speed or force is beyond: larger numbers only overflow."""


class Registers:
    """Input registers to read and output registers to write, from number `offset` on.

    Args:
        machine: Whose registers.
        offset: 0, or 24 for the upper range.

    Raises:
        CommandRefused: This software has no upper range.
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
        """An integer that a client has written."""
        return int(self._in.flat[self._ints + number])

    def double(self, number: int) -> float:
        """A number that a client has written.

        Raises:
            CommandRefused: It is too large for any physical quantity, or no number at all.
        """
        value = float(self._in.flat[self._doubles + number])
        if not abs(value) <= LARGEST:
            raise CommandRefused(f"input double register {self.offset + number} is {value}")
        return value

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        """(count,) numbers that a client has written; see `double`."""
        return np.array([self.double(first + i) for i in range(count)])

    def put_integer(self, number: int, value: int) -> None:
        """Write an integer register for clients.

        Raises:
            CommandRefused: There is no such register, or it does not hold such a value.
        """
        name = f"output_int_register_{self.offset + number}"
        if name not in self._out or not -INT32 <= value < INT32:
            raise CommandRefused(f"cannot write {value} to {name}")
        self._out[name] = int(value)

    def put_doubles(self, first: int, values: Iterable[float]) -> None:
        """Write number registers for clients.

        Raises:
            CommandRefused: There is no such register.
        """
        for number, value in enumerate(values, self.offset + first):
            name = f"output_double_register_{number}"
            if name not in self._out:
                raise CommandRefused(f"there is no {name}")
            self._out[name] = float(value)


WORD, LARGEST_COUNT, MOST_PROGRESS = 2, 127, 0x7FFF
RUNNING = 1 << 15


class Operation:
    """Bits 0–14 progress, 15 running, 16–23 count of changes, 24–30 number of the operation.

    Args:
        registers: Where it is reported, in integer 2.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._changes = self._number = 0
        self.finish()

    def start(self) -> None:
        """Another operation begins."""
        self.progress(0)

    def progress(self, value: int) -> None:
        """It has come to `value`; 0 counts as another operation, as in the script."""
        if value == 0:
            self._number = (self._number + 1) % (LARGEST_COUNT + 1)
        self._tell(RUNNING + min(value, MOST_PROGRESS))

    def finish(self) -> None:
        """None is under way."""
        self._tell(0)

    def _tell(self, rest: int) -> None:
        self._changes = (self._changes + 1) % (LARGEST_COUNT + 1)
        self._registers.put_integer(WORD, self._number << 24 | self._changes << 16 | rest)


SINCE = (None, (5, 4))
"""Software that can tell contacts and the joints' past."""

LEAST_FORCE_N = 10.0
REMEMBERED_S = 2.0


class Touch:
    """Detects contacts, once a tick; software without that function detects none.

    Attributes:
        force: (3,) on the tool in the base frame, None when nothing pushes [N].
        ticks: Since when something pushes.
    """

    def __init__(self) -> None:
        self.force: FloatArray | None = None
        self.ticks = 0
        self._past: deque[FloatArray] = deque()

    def look(self, machine: Machine) -> None:
        """Note joint positions and external torques."""
        if not machine.series.at_least(*SINCE):
            return
        self._past.append(machine.reading.q)
        if len(self._past) > REMEMBERED_S / machine.tick_s:
            self._past.popleft()
        self.force = _force_of(machine)
        self.ticks = self.ticks + 1 if self.force is not None else 0

    def along(self, direction: FloatArray) -> int:
        """Ticks since the tool met something on its way, 0 when it has not.

        Args:
            direction: (6,) of the way, of which the translation counts; zero for any.
        """
        if self.force is None or (direction[:3].any() and direction[:3] @ self.force >= 0):
            return 0
        return min(self.ticks, len(self._past) - 1)

    def past(self, ticks: int) -> FloatArray | None:
        """(6,) joint angles so many ticks ago [rad]; None when that is too long ago."""
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
