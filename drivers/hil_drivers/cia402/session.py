"""Connection to the drives of an arm, from opening to closing the bus.

`Session` configures all drives, starts the cycles, resets resettable faults, and enables all axes
at their present positions. At its end, a session brings the arm to rest, switches the axes off and
closes the bus. A session owns the parts of a connected arm: the drives as read (`commissioning`),
the cycles (`core`), the motion (`player`) and the torque model. `Session.findings` returns the
preflight checks of the driver. The module also contains three classes that only a connected arm
needs:

- `Samples` takes the records of the cycles and converts the records to rows.
- `Trouble` detects problems of the arm and raises each problem at the next read.
- `Thermometer` requests the motor temperatures of the drives while the cycles run.

This module is independent of the type of bus; `AxesRobot` selects the bus.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from hil.arms import ArmDescription
from hil.core import (
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StructArray,
)
from hil.robot import Finding, Limits, Status, Topic
from hil_drivers.arm import limits_of
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.axis import (
    FAULTY,
    LONGEST_RAMP_S,
    BrakeWatch,
    Tracking,
    state_of,
    statusword_text,
)
from hil_drivers.cia402.bus import MASTER_SILENCE_MS, Acyclic, Bus, Outputs, pumping
from hil_drivers.cia402.commissioning import (
    MODES,
    Commissioned,
    LeftFault,
    configured,
    faults_left,
    inspected,
    part,
    require_resettable,
    set_mode,
    stop_by_objects,
    unwatch,
)
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.gains import gains_of
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.mapping import Mapping as PdoMapping
from hil_drivers.cia402.objects import Entry, error_text
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.rows import INCOMPLETE, TOPIC, StateRows, raw_rows
from hil_drivers.cia402.supervisor import Phase, Supervisor
from hil_drivers.cia402.timing import Schedule
from hil_drivers.cia402.torque import HINT as TORQUE_HINT
from hil_drivers.cia402.torque import GravityComparison, TorqueModel
from hil_drivers.cia402.track import Track

REST_LOOK_S = 0.002

HOTTEST_C = 90.0
"""Motor temperature above which the preflight check fails [°C].

Motor windings withstand 120 to 155 °C; grease and sensors withstand less.
"""

OUTSIDE_RAD = 0.01
"""Distance by which a joint at an end stop is allowed to be outside of its range [rad]."""

MOST_OVERRUN = 0.10
"""Maximum share of late cycles: CSP drives bridge one missing set-point, not several."""


class Session:
    """Connection to the drives of an arm, from opening to closing the bus.

    Args:
        name: Name of the robot.
        arm: Description of the arm.
        options: Options of the arm in the station.
        bus: Open bus; the session closes the bus at its end, or if the session cannot be created.
        topic: Topic of the raw rows, from `rows.raw_topic`.
        torque: Torque model of the arm; None if no torques are sent to the drives.

    Attributes:
        acyclic: Access to the objects of the drives.
        drives: Drives of the arm after they were read and configured.
        core: Cyclic exchange.
        player: Player of prepared motions.
        faults_reset: Descriptions of the faults that the drives had when connecting, and that the
            session resets.
        samples: Reader that returns the rows of the cycles.
        trouble: Detector of problems of the drives.
        thermometer: Reader of the motor temperatures.

    Raises:
        RobotConnectionError: The drives do not match the station, or the connection to the bus is
            lost.
        RobotFault: A drive has a fault whose cause an operator must remove.
        RobotTimeout: A drive does not answer.
        CommandRefused: A drive does not accept a setting.
    """

    def __init__(
        self,
        name: str,
        arm: ArmDescription,
        options: Options,
        bus: Bus,
        topic: Topic,
        torque: TorqueModel | None,
    ) -> None:
        self.options, self.arm, self.bus, self.torque = options, arm, bus, torque
        self.mapping, self.acyclic = MAPPINGS[options.mapping], bus.acyclic
        try:
            with pumping(bus.cyclic):
                self._set_up()
            self.core, self.player = self._core()
        except BaseException:
            bus.close()
            raise
        scaling, period_s = self.drives.scaling, options.period_s
        rows = StateRows(self.mapping, scaling, period_s, options.effort)
        self.samples = Samples(self.core, self.mapping, topic, rows, period_s)
        self.trouble = Trouble(name, self.core, self.acyclic, self.samples)
        self.thermometer = Thermometer(self.acyclic, options.temperature_object)

    def begin(self, go_on: Callable[[], None] = lambda: None) -> None:
        """Start the cycles, reset faults, and enable all axes, which then hold their positions.

        Args:
            go_on: Callback before every step; an exception from the callback ends the method.

        Raises:
            RobotTimeout: See `Core`.
            RobotFault: See `Core`.
            CommandRefused: See `Core`.
            RobotConnectionError: The connection to the bus is lost, or the measured torques cannot
                hold the arm.
        """
        self.core.open()
        go_on()
        self.acyclic.operational()
        self.core.run()
        if self.faults_reset:
            go_on()
            self.core.reset_faults()
        if not self.mapping.carries_mode:
            set_mode(self.acyclic, range(self.acyclic.n), od.CSP)
        go_on()
        self.core.enable(od.CSP)
        go_on()
        self.require_plausible_torques()
        go_on()
        if (mode := MODES[self.options.trajectory_mode]) != od.CSP:
            # An arm enabled directly in a torque mode falls until the controller holds it.
            self.core.switch(mode)
            go_on()
        self.thermometer.ask_all()
        self.samples.forget()
        go_on()

    def require_plausible_torques(self) -> None:
        """Raise if the torques measured by the drives contradict the gravity torques of the model.

        The session checks gravity before the first torque is sent to a drive.

        Raises:
            RobotConnectionError: The measured torques cannot hold the arm; the message contains
                axis and values.
        """
        comparison = None if self.torque is None else self._compare_with_gravity(self.torque)
        if comparison is not None and (wrong := comparison.contradictions):
            raise RobotConnectionError("\n".join(wrong), hint=TORQUE_HINT)

    def _compare_with_gravity(self, model: TorqueModel) -> GravityComparison | None:
        """Compare the torques measured while the axes hold with the gravity torques of the model.

        Returns:
            Comparison of the torques; None if the process data do not contain the measured torque
            (6077h).

        Raises:
            RobotError: The torque measurement failed; see `Core.mean_torque`.
        """
        if od.TORQUE not in self.mapping.entries:
            return None
        scaling, arm = self.drives.scaling, self.arm
        measured = scaling.torque(self.core.mean_torque())
        gravity = model.holding(scaling.position(self.player.position))[0]
        return GravityComparison(measured, gravity, np.array(arm.effort_max), arm.joint_names)

    def hold_anew(self) -> None:
        """Hold the present position with the holding torques of the new payload.

        Raises:
            CommandRefused: The arm moves while the payload is changed.
        """
        if self.torque is None:
            return
        scaling, position = self.drives.scaling, np.array([self.player.position])
        torque = scaling.raw_torque(self.torque.holding(scaling.position(position)))
        at_rest = np.zeros_like(position)
        self.core.prepare(Track(self.player.segment, position, at_rest, torque, holding=torque))
        self.core.start()

    def findings(self, model: TorqueModel) -> Iterator[Finding]:
        """Yield the driver's preflight checks, each with its measured value, without any motion.

        Args:
            model: Torque model of the arm with its payload, for the gravity torques.
        """
        objects = [drive.objects for drive in self.drives.drives]
        kinds = {(o.get("vendor", 0), o.get("product", 0)) for o in objects}
        makes = ", ".join(f"vendor {v:X}h product {p:X}h" for v, p in sorted(kinds))
        serials = " ".join(f"{o.get('serial', 0):x}" for o in objects)
        message = f"{len(objects)} CiA 402 drives: {makes}; serials {serials}"
        yield Finding("drives", True, message, makes)
        yield self._enabled_finding()
        yield self.bus.load()
        yield self._scaling_finding()
        yield self._limits_finding()
        most = self.drives.max_torque
        limits = " ".join("?" if np.isnan(each) else f"{each:.0f}" for each in most)
        message = f"the drives limit their torque to {limits} N·m (6072h)"
        yield Finding("torque-limits", True, message, limits)
        yield self._gravity_finding(model)
        yield self._watchdog_finding()
        yield _temperature_finding(self.core.temperature)
        yield self._cycle_finding()
        if self.faults_reset:
            message = "faults reset when connecting: " + "; ".join(map(str, self.faults_reset))
            yield Finding("faults-left", True, message, len(self.faults_reset))

    def _enabled_finding(self) -> Finding:
        phase, options = self.core.phase, self.options
        read_back = (
            "6061h, read back in every cycle"
            if self.mapping.carries_mode
            else "6061h, read back before enabling only, because mapping "
            f"{options.mapping} does not contain it"
        )
        return Finding(
            "drives-enabled",
            phase is Phase.ENABLED,
            f"all axes are {phase.value}, in mode {options.trajectory_mode} ({read_back})",
            phase.value,
            Phase.ENABLED.value,
            "connect again",
        )

    def _scaling_finding(self) -> Finding:
        """Return the check with the resolutions; contradictory scaling is rejected earlier."""
        scaling = self.drives.scaling
        torque, q = scaling.torque_resolution, scaling.position_resolution
        given = sorted({key for axis in self.options.axes for key in axis} - {"centre_rad"})
        source = f"{', '.join(given)} from the station, others" if given else "all values"
        message = (
            f"scaling ({source} from the drives, without contradiction): one increment of torque "
            f"is {torque.min():.3g} to {torque.max():.3g} N·m at the joints, one increment of "
            f"position is at most {q.max():.2g} rad"
        )
        return Finding("scaling", True, message, float(torque.max()))

    def _limits_finding(self) -> Finding:
        drives, arm = self.drives, self.arm
        makers = limits_of(arm.name)
        used = limits_of(arm.name, drives.reported_limits)
        narrower = float(max((used.q_min - makers.q_min).max(), (makers.q_max - used.q_max).max()))
        message = "the joint range used is within the limits of the drives (607Dh), which are "
        if narrower <= 0:
            message += "as wide as the manufacturer's"
        else:
            message += f"up to {narrower:.3f} rad narrower than the manufacturer's"
        if without := int(np.isnan(drives.q_min).sum()):
            message += f"; {without} of {len(drives.drives)} drives have no position limits"
        outside = outside_of(drives.scaling.position(self.player.position), used, arm.joint_names)
        passed = bool((used.q_min < used.q_max).all()) and not outside
        hint = "correct 607Dh in the drives, or axes.offset_deg in the station"
        return Finding("joint-limits", passed, "; ".join([*outside, message]), narrower, hint=hint)

    def _gravity_finding(self, model: TorqueModel) -> Finding:
        """Return the check of measured torques against gravity; required if torques are sent."""
        options, phase = self.options, self.core.phase
        comparison = self._compare_with_gravity(model) if phase is Phase.ENABLED else None
        if comparison is None:
            message = f"torques not compared with gravity: mapping {options.mapping}, axes "
            return Finding("torque-sign", True, message + phase.value, "not compared")
        if wrong := comparison.contradictions:
            needed = options.feed_forward or options.trajectory_mode == "cst"
            message = "; ".join(wrong)
            if not needed:
                message += ". No torque is sent in this mode, but recordings contain it"
            return Finding("torque-sign", not needed, message, len(wrong), 0, TORQUE_HINT)
        names = [comparison.names[axis] for axis in comparison.compared]
        message = f"measured torques agree with gravity in {', '.join(names)}"
        if not names:
            message = "no joint carries enough weight in this pose to check the sign of its torque"
        return Finding("torque-sign", True, message, 0, 0)

    def _watchdog_finding(self) -> Finding:
        message = (
            f"every drive stops by itself {MASTER_SILENCE_MS} ms after the last heartbeat of this "
            f"computer, or if its following error exceeds {self.options.following_error_deg:g}° "
            "(settings read back)"
        )
        if lacking := sorted({name for each in self.drives.lacking for name in each}):
            message += f"; not available: {', '.join(lacking)}"
        return Finding("drives-watch", True, message, MASTER_SILENCE_MS / 1000)

    def _cycle_finding(self) -> Finding:
        """Return the preflight check of the share of late cycles since the first cycle."""
        schedule = self.core.schedule
        late, p99 = schedule.overrun / max(schedule.cycles, 1), schedule.lateness.percentile(99)
        message = (
            f"{schedule.cycles} cycles, {late:.1%} overrun, woken within {1e6 * p99:.0f} µs "
            f"(99 %); {'; '.join(self.core.not_permitted) or 'real-time priority is permitted'}"
        )
        if losses := self.bus.losses():
            message += f"; {losses}"
        hint = "end other programs on this computer, permit real-time priority, or lower rate_hz"
        return Finding("cycle", late <= MOST_OVERRUN, message, round(late, 4), MOST_OVERRUN, hint)

    def leave(self, *, rest_s: float) -> None:
        """Stop the arm, switch all axes off and close the bus; never raise.

        Args:
            rest_s: Longest wait for the arm to come to rest [s].
        """
        with contextlib.suppress(HilError):
            self.core.stop(self.options.stop_rad_s2)
            until = time.monotonic() + rest_s
            while self.player.moving and time.monotonic() < until:
                time.sleep(REST_LOOK_S)
            self.core.rest()
        with contextlib.suppress(HilError):
            part(self.acyclic)
            self.acyclic.release()
        self.core.close()
        self.bus.close()

    def _set_up(self) -> None:
        try:
            self.acyclic.preoperational()
            uncommissioned = inspected(self.acyclic, self.options, self.arm)
            # Read before the drives monitor this master: a lost heartbeat hides earlier errors.
            self.faults_reset: list[LeftFault] = faults_left(self.acyclic)
            require_resettable(self.faults_reset)
            self.drives: Commissioned = configured(self.acyclic, self.options, uncommissioned)
            self.acyclic.map(self.mapping)
        except BaseException:
            unwatch(self.acyclic)
            raise

    def _core(self) -> tuple[Core, Player]:
        options, drives = self.options, self.drives.drives
        outputs = Outputs.idle(len(drives))
        supervisor = Supervisor(
            options.nodes,
            options.period_s,
            outputs,
            mode_mapped=self.mapping.carries_mode,
            late_cycles=options.late_cycles,
            braking=self._brake_watch(),
            tracking=self._tracking(),
            names=self.arm.joint_names,
        )
        player = Player(
            options.period_s,
            [drive.profile.rad_per_increment for drive in drives],
            feed_forward=options.feed_forward,
            gains=gains_of(options.axes, drives, self.arm),
        )
        core = Core(
            self.bus.cyclic,
            supervisor,
            player,
            outputs,
            Schedule(options.wall_period_s),
            self.mapping,
            period_s=options.period_s,
            wall_period_s=options.wall_period_s,
            late_cycles=options.late_cycles,
            stop_rad_s2=options.stop_rad_s2,
            celsius=self.bus.celsius,
        )
        return core, player

    def _brake_watch(self) -> BrakeWatch:
        drives, fastest = self.drives.drives, self.arm.qd_max
        ramps = [drive.quick_stop_s(float(qd)) for drive, qd in zip(drives, fastest, strict=True)]
        return BrakeWatch(
            self.options.period_s,
            [drive.profile.rad_per_increment for drive in drives],
            [LONGEST_RAMP_S if math.isnan(ramp) else ramp for ramp in ramps],
        )

    def _tracking(self) -> Tracking:
        profiles, options = [drive.profile for drive in self.drives.drives], self.options
        following = (2.0 * options.following_error_deg, "2 × following_error_deg")
        led = (options.tracking_deg, "tracking_deg")
        measured = od.VELOCITY in self.mapping.entries
        return Tracking(
            options.period_s,
            [profile.rad_per_increment for profile in profiles],
            {od.CSP: following, od.CSV: led, od.CST: led},
            [profile.rad_s_per_count for profile in profiles] if measured else (),
        )


def outside_of(q: FloatArray, limits: Limits, names: Sequence[str]) -> list[str]:
    """Return a message, about wrong scaling, for each joint that is outside of its range.

    Args:
        q: (n,) joint positions [rad].
        limits: Stricter limits of the arm and its drives.
        names: Names of the joints.
    """
    beyond = (q < limits.q_min - OUTSIDE_RAD) | (q > limits.q_max + OUTSIDE_RAD)
    degrees = np.degrees(np.stack((q, limits.q_min, limits.q_max)))
    return [
        "{} is at {:.1f}°, outside its range of {:.1f} to {:.1f}°".format(name, *degrees[:, axis])
        for axis, name in enumerate(names)
        if beyond[axis]
    ]


def _temperature_finding(celsius: FloatArray) -> Finding:
    known = celsius[np.isfinite(celsius)]
    if not len(known):
        return Finding("temperatures", True, "the drives report no temperatures", "not reported")
    values = " ".join("?" if np.isnan(each) else f"{each:.1f}" for each in celsius)
    return Finding(
        "temperatures",
        bool(known.max() <= HOTTEST_C),
        f"motors at {values} °C",
        float(known.max()),
        HOTTEST_C,
        "let the arm cool down",
    )


class Samples:
    """Reader of the cycle records: state rows for the caller and raw rows for the recording.

    Args:
        core: Source of the cycle records.
        mapping: Mapping of the process data.
        topic: Topic of the raw rows, from `rows.raw_topic`.
        rows: Converter from cycle records to state rows.
        period_s: Device time of a cycle [s].
    """

    def __init__(
        self, core: Core, mapping: PdoMapping, topic: Topic, rows: StateRows, period_s: float
    ) -> None:
        self._core, self._mapping, self._topic = core, mapping, topic
        self._rows, self._period_s = rows, period_s
        self._raw: list[StructArray] = []
        self._newest: StructArray | None = None

    def take(self, timeout_s: float) -> StructArray:
        """Return the state rows since the last call; no rows if axes have not answered.

        Raises:
            RobotTimeout: No cycle ended within the timeout.
            RobotConnectionError: The connection to the bus is lost.
        """
        cycles = self._core.take(timeout_s)
        self._raw.append(raw_rows(cycles, self._mapping, self._topic, self._period_s))
        self._newest = self._raw[-1][-1:]
        return self._rows.rows(cycles)

    def forget(self) -> None:
        """Drop all rows so far, because these rows belong to the enabling of the axes."""
        self.take(1.0)
        self._raw = []

    def drain(self) -> Mapping[str, StructArray]:
        """Return the raw rows of all cycles since the last call."""
        raw, self._raw = self._raw, []
        return {TOPIC: np.concatenate(raw)} if raw else {}

    @property
    def silent(self) -> Sequence[int]:
        """Numbers of the axes that have not answered in the newest cycle."""
        flags = 0 if self._newest is None else int(self._newest[0]["flags"]) & INCOMPLETE
        return [axis for axis in range(flags.bit_length()) if flags >> axis & 1]

    @property
    def faulty(self) -> Sequence[int]:
        """Numbers of the axes that have answered in the newest cycle and reported a fault."""
        if self._newest is None:
            return ()
        silent, words = self.silent, self._newest[0]["statusword"].tolist()
        return [a for a, word in enumerate(words) if state_of(word) in FAULTY and a not in silent]


DETAILS_S, DETAILS_LOOK_S = 0.5, 0.005
"""Longest wait until the core has all messages about a fault, and the polling period [s]."""

ASKED_S = 0.1
"""Longest wait for the answers of all drives to the requests about a fault [s]."""

NEXT = (
    "remove the cause; reset faults that need an operator with "
    "`python -m hil_drivers.cia402 reset STATION ROBOT`; then run or resume"
)
ALL_SILENT = (
    "all axes at once: check the bus, its power and its adapter; on a simulated bus the computer "
    "is too busy: end other programs, or set `pace: free` in the station"
)


class Trouble:
    """Detector of problems of the arm, which raises each fault only one time.

    Args:
        name: Name of the robot.
        core: Cyclic exchange, which reports the event that stopped the axes.
        acyclic: Access to the objects of the drives, for their error codes.
        samples: Reader whose rows show which axes do not answer or are in fault.

    Attributes:
        is_there: Whether a problem has stopped the arm.
    """

    def __init__(self, name: str, core: Core, acyclic: Acyclic, samples: Samples) -> None:
        self._name, self._core, self._acyclic, self._samples = name, core, acyclic, samples
        self._message = ""
        self._to_raise = self.is_there = False

    def look(self, rows: StructArray) -> None:
        """Update the state from the newest rows and the core; stop all axes at a new problem."""
        known = self.is_there
        if message := self._core.take_problem():
            self._message, self._to_raise, self.is_there = message, True, True
        elif not self.is_there and (rows["status"] & int(Status.FAULT)).any():
            self._to_raise = self.is_there = True
        if self.is_there and not known:
            stop_by_objects(self._acyclic)

    @property
    def text(self) -> str:
        """Message about the problem with all details known so far."""
        return self._message or "a drive is in fault"

    def raise_it(self) -> None:
        """Raise the problem if it was not raised before.

        Raises:
            RobotFault: A problem has stopped the arm; the message contains the axis, the error of
                its drive, and the states of the other axes.
        """
        if not self._to_raise:
            return
        self._to_raise = False
        until = time.monotonic() + DETAILS_S
        while not self._message and time.monotonic() < until:
            self._message = self._core.take_problem()
            time.sleep(DETAILS_LOOK_S)
        all_silent = len(self._samples.silent) == self._acyclic.n
        hint = ALL_SILENT if all_silent else NEXT
        raise RobotFault(f"{self._name}: {self.text}{self._errors_by_object()}", hint=hint)

    def silence(self, within_s: float) -> RobotTimeout:
        """Return the error that reports a read timeout and the axes that have not answered."""
        names = [self._acyclic.name_of(axis) for axis in self._samples.silent]
        if names:
            return RobotTimeout(
                f"{self._name}: no answer from {', '.join(names)} within {within_s:g} s",
                hint="check these drives and their wiring",
            )
        return RobotTimeout(
            f"{self._name}: no cycle ended within {within_s:g} s",
            hint="check whether the computer is overloaded",
        )

    def _errors_by_object(self) -> str:
        """Return the errors as text, read by SDO because EMCYs or process data can be lost."""
        acyclic = self._acyclic
        codes = acyclic.upload_each(od.ERROR_CODE, self._faulty(), ASKED_S)
        words = acyclic.upload_each(od.STATUSWORD, self._samples.silent, ASKED_S)
        answers = {
            "603Fh": [f"{acyclic.name_of(a)} {error_text(code)}" for a, code in codes.items()],
            "6041h": [f"{acyclic.name_of(a)} {statusword_text(word)}" for a, word in words.items()],
        }
        return "".join(f" ({entry}: {'; '.join(each)})" for entry, each in answers.items() if each)

    def _faulty(self) -> Sequence[int]:
        """Return the axes in fault according to the newest row, or else to statuswords read by SDO.

        The function reads statuswords by SDO, because a drive sends an EMCY before the process data
        that show the fault, and rows are read later.
        """
        if faulty := self._samples.faulty:
            return faulty
        silent = self._samples.silent
        others = [axis for axis in range(self._acyclic.n) if axis not in silent]
        words = self._acyclic.upload_each(od.STATUSWORD, others, ASKED_S)
        return [axis for axis, word in words.items() if state_of(word) in FAULTY]


EVERY_S = 1.0
"""Time between two temperature requests to the same drive [s]; motors warm up in minutes."""

FIRST_S = 0.2
"""Longest wait for the first temperatures of all axes together [s]."""


class Thermometer:
    """Periodic reader of motor temperatures, one axis at a time.

    The received temperatures are stored in `Bus.celsius`.

    Args:
        acyclic: Access to the objects of the drives.
        index: Index of the manufacturer-specific temperature object in every drive, an INTEGER16 in
            0.1 °C; 0 if there is no such object.
    """

    def __init__(self, acyclic: Acyclic, index: int) -> None:
        self._acyclic = acyclic
        self._entry = Entry("temperature", index, 0, "h", "0.1 °C")
        self._axis, self._next_s = 0, 0.0

    def ask_all(self) -> None:
        """Request the temperatures of all axes, so that the first sample contains temperatures."""
        if self._entry.index:
            self._acyclic.upload_each(self._entry, range(self._acyclic.n), FIRST_S)
            self._next_s = time.monotonic() + EVERY_S / self._acyclic.n

    def look(self) -> None:
        """Request the temperature of the next axis if a request is due; never raise or wait."""
        now = time.monotonic()
        if now < self._next_s or not self._entry.index:
            return
        self._next_s = now + EVERY_S / self._acyclic.n
        self._acyclic.upload_each(self._entry, [self._axis])
        self._axis = (self._axis + 1) % self._acyclic.n
