"""One connection to the drives of an arm, from joining the bus to leaving it.

`Session` sets all drives up, starts the cycles, resets what may be reset, and enables all axes
where they are; when it ends, it brings the arm to rest, switches the axes off and leaves the bus.
It holds what an arm has while it is connected, most of it described elsewhere: the drives as they
were found (`commissioning`), the cycles (`core`), the motion that is played (`player`), the torque
model. Three things are at home here, because only a connected arm has them:

- `Samples` takes the records of the cycles and makes rows of them.
- `Trouble` knows whether the arm still obeys, and which error the next read raises.
- `Thermometer` asks the drives for their temperatures beside the cycles.

No bus is named here: which one it is, is decided by who makes the session.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hil.arms import ArmDescription
from hil.core import HilError, RobotConnectionError, RobotFault, RobotTimeout, StructArray
from hil.robot import Status, Topic
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.axis import (
    FAULTY,
    LONGEST_RAMP_S,
    BrakeWatch,
    Tracking,
    state_of,
    statusword_text,
)
from hil_drivers.cia402.bus import Acyclic, Bus, Outputs, pumping
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
from hil_drivers.cia402.mapping import INCOMPLETE, MAPPINGS
from hil_drivers.cia402.mapping import Mapping as PdoMapping
from hil_drivers.cia402.objects import Entry, error_text
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.player import Player, Track, gains_of
from hil_drivers.cia402.rows import TOPIC, StateRows, raw_rows
from hil_drivers.cia402.supervisor import Supervisor
from hil_drivers.cia402.timing import Schedule
from hil_drivers.cia402.torque import HINT, TorqueModel, Weighed

REST_LOOK_S = 0.002


class Session:
    """Everything between joining the bus and leaving it.

    Args:
        name: Of the robot.
        arm: Which one it is.
        options: Of the station.
        bus: Open; it is left when this ends, or cannot begin.
        topic: Of the raw rows.
        torque: The model, where drives are told torques.

    Attributes:
        acyclic: Objects of the drives.
        drives: As they were found and set up.
        core: The cycles.
        player: Of prepared motions.
        were_reset: Faults that the drives were in before, and that were reset.
        samples: Of the cycles.
        trouble: What is wrong with the drives.
        thermometer: Asks them beside the cycles.

    Raises:
        RobotConnectionError: Drives are not the station's, or the bus is gone.
        RobotFault: A drive is in a fault that a person has to see to.
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
        """Start the cycles, reset what may be reset, enable all axes; they hold where they are.

        Args:
            go_on: Called before every step; raises when it is not to be taken.

        Raises:
            RobotTimeout, RobotFault, CommandRefused, RobotConnectionError: See `Core`; the last
                also when measured torques cannot be what holds the arm.
        """
        self.core.open()
        go_on()
        self.acyclic.operational()
        self.core.run()
        if self.were_reset:
            go_on()
            self.core.reset_faults()
        if not self.mapping.carries_mode:
            set_mode(self.acyclic, range(self.acyclic.n), od.CSP)
        go_on()
        self.core.enable(od.CSP)
        go_on()
        self.look()
        go_on()
        if (mode := MODES[self.options.trajectory_mode]) != od.CSP:
            # Led by torque, an arm that is only now enabled would fall until the spring holds it.
            self.core.switch(mode)
            go_on()
        self.thermometer.ask_all()
        self.samples.forget()
        go_on()

    def look(self) -> None:
        """Before torques are sent: those that the drives measure have to hold the arm.

        Raises:
            RobotConnectionError: They cannot be what holds it; with axis and figures.
        """
        weighed = None if self.torque is None else self.weighed(self.torque)
        if weighed is not None and (wrong := weighed.contradictions):
            raise RobotConnectionError("\n".join(wrong), hint=HINT)

    def weighed(self, model: TorqueModel) -> Weighed | None:
        """Measure for a moment; the axes hold. None where process data do not carry 6077h.

        Raises:
            RobotError: See `Core.mean_torque`.
        """
        if od.TORQUE not in self.mapping.entries:
            return None
        scaling = self.drives.scaling
        measured = scaling.torque(self.core.mean_torque())
        gravity = model.holding(scaling.position(self.player.position))[0]
        return Weighed(measured, gravity, np.array(self.arm.effort_max), self.arm.joint_names)

    def hold_anew(self) -> None:
        """Hold where the arm is, with the torques that its new load takes.

        Raises:
            CommandRefused: It moves.
        """
        if self.torque is None:
            return
        scaling, held = self.drives.scaling, np.array([self.player.position])
        torque = scaling.raw_torque(self.torque.holding(scaling.position(held)))
        self.core.prepare(Track(self.player.segment, held, np.zeros_like(held), torque))
        self.core.start()

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
            # Before they are made to watch for us: the end of that would hide what they are in.
            self.were_reset: list[LeftFault] = faults_left(self.acyclic)
            require_resettable(self.were_reset)
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


class Samples:
    """State rows for who reads, raw rows for who records.

    Args:
        core: Keeps the records.
        mapping: What travels.
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
        """State rows of all cycles since the last call; none when axes have not answered.

        Raises:
            RobotTimeout: There was no cycle.
            RobotConnectionError: The bus is gone.
        """
        cycles = self._core.take(timeout_s)
        self._raw.append(raw_rows(cycles, self._mapping, self._topic, self._period_s))
        self._newest = self._raw[-1][-1:]
        return self._rows.rows(cycles)

    def forget(self) -> None:
        """Drop what was so far: the axes were being enabled."""
        self.take(1.0)
        self._raw = []

    def drain(self) -> Mapping[str, StructArray]:
        """Raw rows since the last call."""
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


WORDS_S, WORDS_LOOK_S = 0.5, 0.005
"""How long it may take until the core has heard all there is to say of a fault [s]."""

ASKED_S = 0.1
"""How long drives may take to say something of themselves, all together [s]."""

NEXT = (
    "see to the cause; faults that are for a person are reset by "
    "`python -m hil_drivers.cia402 reset STATION ROBOT`; then run or resume"
)
ALL_SILENT = (
    "all axes at once: see to the bus, its power, its adapter; on a simulated bus the computer is "
    "too busy: end other programs, or give the station `pace: free`"
)


class Trouble:
    """Knows whether the arm obeys; raises each fault once.

    Args:
        name: Of the robot.
        core: Says what has stopped the axes.
        acyclic: Asks the drives themselves.
        samples: Say who is silent or in fault.

    Attributes:
        is_there: The arm does not obey any more.
    """

    def __init__(self, name: str, core: Core, acyclic: Acyclic, samples: Samples) -> None:
        self._name, self._core, self._acyclic, self._samples = name, core, acyclic, samples
        self._said = ""
        self._untold = self.is_there = False

    def look(self, rows: StructArray) -> None:
        """Look at what was just read, ask the core; new trouble stops all axes by object."""
        known = self.is_there
        if said := self._core.take_problem():
            self._said, self._untold, self.is_there = said, True, True
        elif not self.is_there and (rows["status"] & int(Status.FAULT)).any():
            self._untold = self.is_there = True
        if self.is_there and not known:
            stop_by_objects(self._acyclic)

    @property
    def said(self) -> str:
        """What is wrong, as far as it is known by now."""
        return self._said or "a drive is in fault"

    def raise_it(self) -> None:
        """Raise what was found, once.

        Raises:
            RobotFault: With the axis, what it says, and what the others do.
        """
        if not self._untold:
            return
        self._untold = False
        until = time.monotonic() + WORDS_S
        while not self._said and time.monotonic() < until:
            self._said = self._core.take_problem()
            time.sleep(WORDS_LOOK_S)
        all_silent = len(self._samples.silent) == self._acyclic.n
        hint = ALL_SILENT if all_silent else NEXT
        raise RobotFault(f"{self._name}: {self.said}{self._asked()}", hint=hint)

    def silence(self, within_s: float) -> RobotTimeout:
        """The error for no sample in that time, with who has kept it from being one."""
        names = [self._acyclic.name_of(axis) for axis in self._samples.silent]
        if names:
            return RobotTimeout(
                f"{self._name}: no answer from {', '.join(names)} within {within_s:g} s",
                hint="see to those drives and their line",
            )
        return RobotTimeout(
            f"{self._name}: no cycle was over within {within_s:g} s", hint="look for a busy machine"
        )

    def _asked(self) -> str:
        """What drives say of themselves by object: an EMCY may be lost, or all process data."""
        acyclic = self._acyclic
        codes = acyclic.upload_each(od.ERROR_CODE, self._faulty(), ASKED_S)
        words = acyclic.upload_each(od.STATUSWORD, self._samples.silent, ASKED_S)
        told = {
            "603Fh": [f"{acyclic.name_of(a)} {error_text(code)}" for a, code in codes.items()],
            "6041h": [f"{acyclic.name_of(a)} {statusword_text(word)}" for a, word in words.items()],
        }
        return "".join(f" ({entry}: {'; '.join(said)})" for entry, said in told.items() if said)

    def _faulty(self) -> Sequence[int]:
        """Axes in fault, by the newest row; by what they say where it was an EMCY that told of one.

        A drive sends that before the process data that show the fault, and rows are read later.
        """
        if faulty := self._samples.faulty:
            return faulty
        silent = self._samples.silent
        others = [axis for axis in range(self._acyclic.n) if axis not in silent]
        words = self._acyclic.upload_each(od.STATUSWORD, others, ASKED_S)
        return [axis for axis, word in words.items() if state_of(word) in FAULTY]


EVERY_S = 1.0
"""How often each axis is asked [s]; motors warm up over minutes."""

FIRST_S = 0.2
"""How long the first answers of all axes are waited for [s]."""


class Thermometer:
    """Asks for one temperature at a time, in turns; the bus takes the answers (`Bus.celsius`).

    Args:
        acyclic: The drives; their answers are not waited for.
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
        """Ask the axis whose turn it is, if it is time; never raises, does not wait."""
        now = time.monotonic()
        if now < self._next_s or not self._entry.index:
            return
        self._next_s = now + EVERY_S / self._acyclic.n
        self._acyclic.upload_each(self._entry, [self._axis])
        self._axis = (self._axis + 1) % self._acyclic.n
