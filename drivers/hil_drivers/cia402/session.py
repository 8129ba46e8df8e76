"""One connection to the drives: the bus joined, all axes set up, cycles going on, axes enabled."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable

from hil.arms import load_arm
from hil.core import HilError
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.commissioning import MODES, configured, inspected
from hil_drivers.cia402.contracts import Outputs
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.drives import Commissioned
from hil_drivers.cia402.emergencies import emergency_text
from hil_drivers.cia402.gains import gains_of
from hil_drivers.cia402.joining import Joined
from hil_drivers.cia402.left_faults import LeftFault, faults_left, require_resettable
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.mode_object import carries_mode, set_mode
from hil_drivers.cia402.node_watch import Counts
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.parting import part, unwatch
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.pumping import pumping
from hil_drivers.cia402.rest_watch import LONGEST_RAMP_S, BrakeWatch
from hil_drivers.cia402.schedule import Schedule
from hil_drivers.cia402.supervisor import Supervisor
from hil_drivers.cia402.tracking import Tracking

LOOK_S = 0.002


class Session:
    """Everything between joining the bus and leaving it.

    Args:
        model: Built-in arm.
        options: Of the station.

    Attributes:
        acyclic: Objects of the drives.
        drives: As they were found and set up.
        core: The cycles.
        player: Of prepared motions.
        were_reset: Faults that the drives were in before, and that were reset.

    Raises:
        RobotConnectionError: The bus cannot be joined, or drives are not the station's.
        RobotFault: A drive is in a fault that a person has to see to.
        RobotTimeout, CommandRefused: A drive does not answer, or does not take a setting.
        PluginError: A package is missing.
        RecordingError: The log of the bus cannot be made.
    """

    def __init__(self, model: str, options: Options) -> None:
        self.options, self.arm = options, load_arm(model)
        self.mapping = MAPPINGS[options.mapping]
        self._joined = Joined(options, self.arm.joint_names)
        self.acyclic = self._joined.acyclic
        try:
            with pumping(self._joined.cyclic):
                self._set_up()
            self.core, self.player = self._core()
        except BaseException:
            self._joined.leave()
            raise

    def begin(
        self,
        go_on: Callable[[], None] = lambda: None,
        look: Callable[[], None] = lambda: None,
    ) -> None:
        """Start the cycles, reset what may be reset, enable all axes; they hold where they are.

        Args:
            go_on: Called before every step; raises when it is not to be taken.
            look: Called when all axes hold by their own loops; raises when they are to do no more.

        Raises:
            RobotTimeout, RobotFault, CommandRefused, RobotConnectionError: See `Core`.
        """
        self.core.open()
        go_on()
        self.acyclic.operational()
        self.core.run()
        if self.were_reset:
            go_on()
            self.core.reset_faults()
        if not carries_mode(self.mapping):
            set_mode(self.acyclic, range(len(self.options.nodes)), od.CSP)
        go_on()
        self.core.enable(od.CSP)
        go_on()
        look()
        go_on()
        if (mode := MODES[self.options.trajectory_mode]) != od.CSP:
            # Led by torque, an arm that is only now enabled would fall until the spring holds it.
            self.core.switch(mode)
            go_on()

    @property
    def counts(self) -> Counts:
        """What has gone wrong on the bus since the connection was opened."""
        return self._joined.cyclic.counts

    def flush(self) -> None:
        """Write what the log of the bus has kept."""
        self._joined.flush()

    def leave(self, *, rest_s: float) -> None:
        """Come to rest, switch all axes off, leave the bus; never raises.

        Args:
            rest_s: How long to wait for the arm to come to rest [s].
        """
        with contextlib.suppress(HilError):
            self.core.stop(self.options.stop_rad_s2)
            self._await_rest(rest_s)
            self.core.rest()
        with contextlib.suppress(HilError):
            part(self.acyclic)
            self.acyclic.released()
        self.core.close()
        self._joined.leave()

    def _set_up(self) -> None:
        try:
            self.acyclic.preoperational()
            found = inspected(self.acyclic, self.options, self.arm)
            # Before they are made to watch our heartbeat: its end would hide what they are in.
            self.were_reset: list[LeftFault] = faults_left(self.acyclic)
            require_resettable(self.were_reset)
            self.drives: Commissioned = configured(self.acyclic, self.options, found)
            self.acyclic.map(self.mapping)
        except BaseException:
            unwatch(self.acyclic)
            raise

    def _core(self) -> tuple[Core, Player]:
        options, n = self.options, len(self.options.nodes)
        outputs = Outputs.idle(n)
        supervisor = Supervisor(
            options.nodes,
            options.period_s,
            outputs,
            mode_mapped=carries_mode(self.mapping),
            late_cycles=options.late_cycles,
            braking=self._brake_watch(),
            tracking=self._tracking(),
            said=emergency_text,
            names=self.arm.joint_names,
        )
        player = Player(
            options.period_s,
            [drive.profile.rad_per_increment for drive in self.drives.drives],
            feed_forward=options.feed_forward,
            gains=gains_of(options.axes, self.drives.drives, self.arm),
        )
        core = Core(
            self._joined.cyclic,
            supervisor,
            player,
            outputs,
            Schedule(options.wall_period_s),
            self.mapping,
            period_s=options.period_s,
            wall_period_s=options.wall_period_s,
            late_cycles=options.late_cycles,
            stop_rad_s2=options.stop_rad_s2,
        )
        self._joined.temperatures.celsius = core.temperature
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
        measured = any(od.VELOCITY in pdo.entries for pdo in self.mapping.tpdos)
        return Tracking(
            options.period_s,
            [profile.rad_per_increment for profile in profiles],
            {od.CSP: following, od.CSV: led, od.CST: led},
            [profile.rad_s_per_count for profile in profiles] if measured else (),
        )

    def _await_rest(self, within_s: float) -> None:
        until = time.monotonic() + within_s
        while self.player.moving and time.monotonic() < until:
            time.sleep(LOOK_S)
