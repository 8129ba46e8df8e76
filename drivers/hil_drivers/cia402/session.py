"""One connection to the drives of an arm, from joining the bus to leaving it.

`Session` sets all drives up, starts the cycles, resets faults that may be reset, and enables all
axes where they are; when it ends, it brings the arm to rest, switches the axes off and leaves the
bus. It has the parts of a connected arm: the drives as they were read (`commissioning`), the cycles
(`core`), the motion that is played (`player`), the torque model; and its `findings` are the
driver's lines of a preflight. Three parts are defined here, because only a connected arm has them:

- `Samples` takes the records of the cycles and makes rows of them.
- `Trouble` follows whether the arm obeys, and has the error that the next read raises.
- `Thermometer` asks the drives for their temperatures beside the cycles.

No particular bus is named here: `AxesRobot` decides on it.
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
"""Motors hotter than this are not moved: windings stand 120 to 155 °C, grease and sensors less."""

OUTSIDE_RAD = 0.01
"""A joint that rests at its end may be beyond it by so much [rad]."""

MOST_OVERRUN = 0.10
"""Share of cycles that may be late: CSP drives interpolate over one, and fault after a few."""


class Session:
    """Drives of an arm, from joining the bus to leaving it.

    Args:
        name: Of the robot.
        arm: Description of the arm.
        options: Of the station.
        bus: Open; it is left when the session ends, or cannot begin.
        topic: Of the raw rows.
        torque: The model, where the drives get torques.

    Attributes:
        acyclic: Objects of the drives.
        drives: As they were read and set up.
        core: The cycles.
        player: Of prepared motions.
        faults_reset: Faults that the drives were in at connecting, and that were reset.
        samples: Of the cycles.
        trouble: Problems of the drives.
        thermometer: Of the motors.

    Raises:
        RobotConnectionError: Drives are not the station's, or the bus is gone.
        RobotFault: A drive is in a fault that a person has to remove.
        RobotTimeout, CommandRefused: A drive does not answer, or does not take a setting.
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
        """Start the cycles, reset faults, enable all axes; they hold where they are.

        Args:
            go_on: Called before every step; raises to end here.

        Raises:
            RobotTimeout, RobotFault, CommandRefused, RobotConnectionError: See `Core`; the last
                also when measured torques cannot be what holds the arm.
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
            # Led by torque, an arm that is only now enabled would fall until the spring holds it.
            self.core.switch(mode)
            go_on()
        self.thermometer.ask_all()
        self.samples.forget()
        go_on()

    def require_plausible_torques(self) -> None:
        """Before torques are sent, compare those that the drives measure with gravity.

        Raises:
            RobotConnectionError: They cannot hold the arm; with axis and figures.
        """
        comparison = None if self.torque is None else self._compare_with_gravity(self.torque)
        if comparison is not None and (wrong := comparison.contradictions):
            raise RobotConnectionError("\n".join(wrong), hint=TORQUE_HINT)

    def _compare_with_gravity(self, model: TorqueModel) -> GravityComparison | None:
        """Measure torques while the axes hold; None where process data do not have 6077h.

        Raises:
            RobotError: See `Core.mean_torque`.
        """
        if od.TORQUE not in self.mapping.entries:
            return None
        scaling, arm = self.drives.scaling, self.arm
        measured = scaling.torque(self.core.mean_torque())
        gravity = model.holding(scaling.position(self.player.position))[0]
        return GravityComparison(measured, gravity, np.array(arm.effort_max), arm.joint_names)

    def hold_anew(self) -> None:
        """Hold where the arm is, with the torques that its new load needs.

        Raises:
            CommandRefused: It moves.
        """
        if self.torque is None:
            return
        scaling, position = self.drives.scaling, np.array([self.player.position])
        torque = scaling.raw_torque(self.torque.holding(scaling.position(position)))
        at_rest = np.zeros_like(position)
        self.core.prepare(Track(self.player.segment, position, at_rest, torque, holding=torque))
        self.core.start()

    def findings(self, model: TorqueModel) -> Iterator[Finding]:
        """Yield the driver's lines of a preflight, with the figures; nothing moves.

        Args:
            model: Of the arm with its load, for its gravity torques.
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
        message = f"drives limit themselves to {limits} N·m (6072h)"
        yield Finding("torque-limits", True, message, limits)
        yield self._gravity_finding(model)
        yield self._watchdog_finding()
        yield _temperature_finding(self.core.temperature)
        yield self._cycle_finding()
        if self.faults_reset:
            message = "reset when connecting: " + "; ".join(map(str, self.faults_reset))
            yield Finding("faults-left", True, message, len(self.faults_reset))

    def _enabled_finding(self) -> Finding:
        phase, options = self.core.phase, self.options
        read_back = (
            "6061h, read back in every cycle"
            if self.mapping.carries_mode
            else "6061h, read back before enabling; mapping "
            f"{options.mapping} does not carry it since"
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
        """Return the resolutions; contradictory scaling has already refused the connection."""
        scaling = self.drives.scaling
        torque, q = scaling.torque_resolution, scaling.position_resolution
        given = sorted({key for axis in self.options.axes for key in axis} - {"centre_rad"})
        source = f"by the station: {', '.join(given)}; all else" if given else "all"
        message = (
            f"scaling ({source} by the drives, nothing contradictory): one count of torque is "
            f"{torque.min():.3g} to {torque.max():.3g} N·m at the joints, one of position "
            f"{q.max():.2g} rad at most"
        )
        return Finding("scaling", True, message, float(torque.max()))

    def _limits_finding(self) -> Finding:
        drives, arm = self.drives, self.arm
        makers = limits_of(arm.name)
        used = limits_of(arm.name, drives.reported_limits)
        narrower = float(max((used.q_min - makers.q_min).max(), (makers.q_max - used.q_max).max()))
        message = "joint range used is no wider than the drives' own (607Dh), which is "
        if narrower <= 0:
            message += "as wide as the maker's"
        else:
            message += f"narrower than the maker's by up to {narrower:.3f} rad"
        if without := int(np.isnan(drives.q_min).sum()):
            message += f"; {without} of {len(drives.drives)} drives have no limits of their own"
        outside = outside_of(drives.scaling.position(self.player.position), used, arm.joint_names)
        passed = bool((used.q_min < used.q_max).all()) and not outside
        hint = "correct 607Dh in the drives, or axes.offset_deg in the station"
        return Finding("joint-limits", passed, "; ".join([*outside, message]), narrower, hint=hint)

    def _gravity_finding(self, model: TorqueModel) -> Finding:
        """Return whether measured torque can hold the arm; it has to where torques are sent."""
        options, phase = self.options, self.core.phase
        comparison = self._compare_with_gravity(model) if phase is Phase.ENABLED else None
        if comparison is None:
            message = f"not compared with the arm's weight: mapping {options.mapping}, axes "
            return Finding("torque-sign", True, message + phase.value, "not compared")
        if wrong := comparison.contradictions:
            needed = options.feed_forward or options.trajectory_mode == "cst"
            message = "; ".join(wrong)
            message += "" if needed else ". No torque is sent in this mode, but recordings hold it"
            return Finding("torque-sign", not needed, message, len(wrong), 0, TORQUE_HINT)
        names = [comparison.names[axis] for axis in comparison.compared]
        message = f"measured torque holds the arm's weight in {', '.join(names)}"
        if not names:
            message = "no joint carries enough weight here to tell the sign of its torque"
        return Finding("torque-sign", True, message, 0, 0)

    def _watchdog_finding(self) -> Finding:
        message = (
            f"every drive stops by itself when it has not heard of us for {MASTER_SILENCE_MS} ms, "
            f"or lags by more than {self.options.following_error_deg:g}°; read back"
        )
        if lacking := sorted({name for each in self.drives.lacking for name in each}):
            message += f"; not settable: {', '.join(lacking)}"
        return Finding("drives-watch", True, message, MASTER_SILENCE_MS / 1000)

    def _cycle_finding(self) -> Finding:
        """Return how punctual the cycles have been since they began."""
        schedule = self.core.schedule
        late, p99 = schedule.overrun / max(schedule.cycles, 1), schedule.lateness.percentile(99)
        message = (
            f"{schedule.cycles} cycles, {late:.1%} overrun, woken within {1e6 * p99:.0f} µs "
            f"(99 %); {'; '.join(self.core.not_permitted) or 'real-time priority is permitted'}"
        )
        if losses := self.bus.losses():
            message += f"; {losses}"
        hint = "free the computer of other work, permit real-time priority, or lower rate_hz"
        return Finding("cycle", late <= MOST_OVERRUN, message, round(late, 4), MOST_OVERRUN, hint)

    def leave(self, *, rest_s: float) -> None:
        """Come to rest, switch all axes off, leave the bus; never raises.

        Args:
            rest_s: How long to wait for the arm to come to rest [s].
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
            found = inspected(self.acyclic, self.options, self.arm)
            # Before they watch for this master: the error at the end of that would hide the others.
            self.faults_reset: list[LeftFault] = faults_left(self.acyclic)
            require_resettable(self.faults_reset)
            self.drives: Commissioned = configured(self.acyclic, self.options, found)
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
    """Return, in words, joints outside of their range: the scaling of their drives is wrong.

    Args:
        q: (n,) joint positions [rad].
        limits: Of the arm and its drives.
        names: Of the joints.
    """
    beyond = (q < limits.q_min - OUTSIDE_RAD) | (q > limits.q_max + OUTSIDE_RAD)
    degrees = np.degrees(np.stack((q, limits.q_min, limits.q_max)))
    return [
        "{} is at {:.1f}°, outside of its range of {:.1f} to {:.1f}°".format(
            name, *degrees[:, axis]
        )
        for axis, name in enumerate(names)
        if beyond[axis]
    ]


def _temperature_finding(celsius: FloatArray) -> Finding:
    known = celsius[np.isfinite(celsius)]
    if not len(known):
        return Finding("temperatures", True, "the drives tell no temperatures", "not told")
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
    """State rows for reading, raw rows for recording.

    Args:
        core: Has the records of the cycles.
        mapping: Of the process data.
        topic: Of the raw rows.
        rows: Makes state rows.
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
        """Return state rows of all cycles since the last call; none if axes have not answered.

        Raises:
            RobotTimeout: There was no cycle.
            RobotConnectionError: The bus is gone.
        """
        cycles = self._core.take(timeout_s)
        self._raw.append(raw_rows(cycles, self._mapping, self._topic, self._period_s))
        self._newest = self._raw[-1][-1:]
        return self._rows.rows(cycles)

    def forget(self) -> None:
        """Drop all rows so far: the axes were being enabled."""
        self.take(1.0)
        self._raw = []

    def drain(self) -> Mapping[str, StructArray]:
        """Return raw rows since the last call."""
        raw, self._raw = self._raw, []
        return {TOPIC: np.concatenate(raw)} if raw else {}

    @property
    def silent(self) -> Sequence[int]:
        """Axes that have not answered in the newest cycle."""
        flags = 0 if self._newest is None else int(self._newest[0]["flags"]) & INCOMPLETE
        return [axis for axis in range(flags.bit_length()) if flags >> axis & 1]

    @property
    def faulty(self) -> Sequence[int]:
        """Axes that were in fault in the newest cycle, and have answered in it."""
        if self._newest is None:
            return ()
        silent, words = self.silent, self._newest[0]["statusword"].tolist()
        return [a for a, word in enumerate(words) if state_of(word) in FAULTY and a not in silent]


DETAILS_S, DETAILS_LOOK_S = 0.5, 0.005
"""How long the core may take to gather all messages about a fault, how often it is asked [s]."""

ASKED_S = 0.1
"""How long all drives together may take to answer questions about a fault [s]."""

NEXT = (
    "see to the cause; faults that are for a person are reset by "
    "`python -m hil_drivers.cia402 reset STATION ROBOT`; then run or resume"
)
ALL_SILENT = (
    "all axes at once: see to the bus, its power, its adapter; on a simulated bus the computer is "
    "too busy: end other programs, or give the station `pace: free`"
)


class Trouble:
    """Whether the arm obeys; raises each fault once.

    Args:
        name: Of the robot.
        core: Has the message of what has stopped the axes.
        acyclic: Asks the drives themselves.
        samples: Show which axes are silent or in fault.

    Attributes:
        is_there: Whether the arm does not obey any more.
    """

    def __init__(self, name: str, core: Core, acyclic: Acyclic, samples: Samples) -> None:
        self._name, self._core, self._acyclic, self._samples = name, core, acyclic, samples
        self._message = ""
        self._to_raise = self.is_there = False

    def look(self, rows: StructArray) -> None:
        """Update from rows that were just read and from the core; new trouble stops all axes."""
        known = self.is_there
        if message := self._core.take_problem():
            self._message, self._to_raise, self.is_there = message, True, True
        elif not self.is_there and (rows["status"] & int(Status.FAULT)).any():
            self._to_raise = self.is_there = True
        if self.is_there and not known:
            stop_by_objects(self._acyclic)

    @property
    def text(self) -> str:
        """The problem in words, as far as it is known."""
        return self._message or "a drive is in fault"

    def raise_it(self) -> None:
        """Raise the problem, once.

        Raises:
            RobotFault: With the axis, its error, and the states of the others.
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
        """Return the error for no sample in that time, with the axes that have not answered."""
        names = [self._acyclic.name_of(axis) for axis in self._samples.silent]
        if names:
            return RobotTimeout(
                f"{self._name}: no answer from {', '.join(names)} within {within_s:g} s",
                hint="see to those drives and their line",
            )
        return RobotTimeout(
            f"{self._name}: no cycle was over within {within_s:g} s", hint="look for a busy machine"
        )

    def _errors_by_object(self) -> str:
        """Ask the drives by object, in words: an EMCY may be lost, or all process data."""
        acyclic = self._acyclic
        codes = acyclic.upload_each(od.ERROR_CODE, self._faulty(), ASKED_S)
        words = acyclic.upload_each(od.STATUSWORD, self._samples.silent, ASKED_S)
        answers = {
            "603Fh": [f"{acyclic.name_of(a)} {error_text(code)}" for a, code in codes.items()],
            "6041h": [f"{acyclic.name_of(a)} {statusword_text(word)}" for a, word in words.items()],
        }
        return "".join(f" ({entry}: {'; '.join(each)})" for entry, each in answers.items() if each)

    def _faulty(self) -> Sequence[int]:
        """Return the axes in fault, by the newest row, else by asking for their statuswords.

        A drive sends an EMCY before the process data that show the fault, and rows are read later.
        """
        if faulty := self._samples.faulty:
            return faulty
        silent = self._samples.silent
        others = [axis for axis in range(self._acyclic.n) if axis not in silent]
        words = self._acyclic.upload_each(od.STATUSWORD, others, ASKED_S)
        return [axis for axis, word in words.items() if state_of(word) in FAULTY]


EVERY_S = 1.0
"""Time between two questions to the same axis [s]; motors warm up over minutes."""

FIRST_S = 0.2
"""How long all axes together may take for their first answers [s]."""


class Thermometer:
    """Asks for one temperature at a time, in turns; the bus takes the answers (`Bus.celsius`).

    Args:
        acyclic: The drives.
        index: Vendor object of every drive, INTEGER16 in 0.1 °C; 0 where there is none.
    """

    def __init__(self, acyclic: Acyclic, index: int) -> None:
        self._acyclic = acyclic
        self._entry = Entry("temperature", index, 0, "h", "0.1 °C")
        self._axis, self._next_s = 0, 0.0

    def ask_all(self) -> None:
        """Ask every axis now, so that the first sample has its temperatures."""
        if self._entry.index:
            self._acyclic.upload_each(self._entry, range(self._acyclic.n), FIRST_S)
            self._next_s = time.monotonic() + EVERY_S / self._acyclic.n

    def look(self) -> None:
        """Ask the next axis if it is time; never raises, does not wait for the answer."""
        now = time.monotonic()
        if now < self._next_s or not self._entry.index:
            return
        self._next_s = now + EVERY_S / self._acyclic.n
        self._acyclic.upload_each(self._entry, [self._axis])
        self._axis = (self._axis + 1) % self._acyclic.n
