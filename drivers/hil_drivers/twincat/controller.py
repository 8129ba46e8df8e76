"""A PLC that was taken: its variables, commands, the heartbeat, the stop."""

from __future__ import annotations

import contextlib
import secrets
import time

import numpy as np

from hil.arms import load_arm
from hil.core import CommandRefused, HilError, RobotConnectionError, RobotFault
from hil.robot import Identity, Segment
from hil_drivers.twincat.beat import Beat
from hil_drivers.twincat.facts import identity_of, require_fit, text
from hil_drivers.twincat.line import Line
from hil_drivers.twincat.options import Options
from hil_drivers.twincat.orders import LOAD_S, Orders
from hil_drivers.twincat.reach import address_of
from hil_drivers.twincat.stopping import Stops
from hil_drivers.twincat.symbols import Order, layout_of
from hil_drivers.twincat.variables import Variables

ANSWER_S, BEAT_S, STOP_S = 1.0, 0.2, 0.03
"""How long an answer may take: in general, to a beat, to a stop before it is written again [s]."""

TAKE_S, SURE_S = 3.0, 0.5
"""How long a braking arm is waited for; a client that has died for so much longer than the PLC's
watchdog takes to notice that [s]."""


class Controller:
    """One PLC, from connecting to letting go.

    Args:
        model: Built-in arm.
        options: Of the station.

    Raises:
        RobotConnectionError: Nobody is there, or it is not what the station says.
        PluginError: Its program keeps another contract, or none.
        CommandRefused: Somebody else has the arm.
        RobotFault: It has a fault that cannot be reset.

    Attributes:
        variables: Of the PLC.
        identity: Who it says to be.
        orders: Commands to it.
        session: Our number.
        stops: To the PLC.
        beat: The heartbeat.
    """

    def __init__(self, model: str, options: Options) -> None:
        arm = load_arm(model)
        layout = layout_of(arm.n_joints)
        self._main, self._beats = Line(options, ANSWER_S), Line(options, BEAT_S)
        self._stopping = Line(options, STOP_S)
        try:
            address = address_of(options)
            for line in (self._main, self._beats, self._stopping):
                line.open(address)
            self.variables = Variables(self._main, layout, options)
            require_fit(self.where, self.info, model, options)
            self.identity: Identity = identity_of(self.info, options, model, self._device())
            self.session = secrets.randbelow(2**32 - 1) + 1
            self.stops = Stops(self.variables, self._stopping)
            self.orders = Orders(
                layout,
                lambda: self.variables.read("stAnswer"),
                self.variables.command,
                self.session,
                arm.joint_names,
            )
            self.beat = self._take(layout.types["stBeat"])
            self.variables.moved = self.beat.hush
        except BaseException:
            self._hang_up()
            raise

    @property
    def where(self) -> str:
        """For messages."""
        return self._main.where

    @property
    def info(self) -> np.void:
        """`stInfo` as it was when we connected."""
        return self.variables.info

    @property
    def watchdog_s(self) -> float:
        """Silence after which the PLC stops the arm [s]."""
        return float(self.info["fWatchdogS"])

    def state(self) -> np.void:
        """`stState`, now; raises as `Line.read`."""
        return self.variables.structure("stState")

    def runtime_state(self) -> int:
        """ADS state of its runtime; raises as `Line.read`."""
        return self._main.state()

    def wait_for(self, timeout_s: float | None = None) -> None:
        """How long answers may take from now on, those to beats and stops left out [s]."""
        self._main.wait_for(ANSWER_S if timeout_s is None else min(timeout_s, ANSWER_S))

    def stop(self) -> None:
        """Tell the PLC to bring the arm to rest, and see that it does; by any thread.

        Raises:
            RobotConnectionError: It could not be told, or does not show that it has seen it; our
                heartbeat has ended then, and its watchdog does it.
        """
        try:
            self.stops.give()
        except HilError as error:
            self.beat.hush()
            raise RobotConnectionError(
                f"{self.where} could not be told to stop: {error.message}; our heartbeat has "
                f"ended, so its watchdog stops the arm within {self.watchdog_s:g} s",
                hint="see to the robot itself, by its emergency stop if need be",
            ) from error

    def load(self, segment: Segment) -> None:
        """Upload set-points and let the PLC check them.

        Raises:
            CommandRefused: There are too many, they leave the limits, or have arrived spoilt.
            RobotError: As `Orders.give`.
        """
        room, rows = int(self.info["nSetPoints"]), len(segment.q)
        if rows > room:
            raise CommandRefused(
                f"segment {segment.index} has {rows} set-points, the PLC has room for {room}",
                hint="plan shorter motions, or raise SET_POINTS in the PLC",
            )
        fields = self.variables.upload(segment)
        what = f"load segment {segment.index} ({segment.kind})"
        answer = self.orders.give(Order.LOAD, what, LOAD_S, **fields)
        if (answer["nSumA"], answer["nSumB"]) != (fields["nSumA"], fields["nSumB"]):
            raise CommandRefused(
                f"{what}: the PLC reads back other set-points than were sent", hint="try again"
            )

    def fault(self, state: np.void) -> str:
        """What the PLC says about its fault."""
        said = text(state["sFault"])
        return f"fault {int(state['nFault'])}" + (f": {said}" if said else "")

    def close(self) -> None:
        """Release the arm and let go of the PLC; raises nothing."""
        with contextlib.suppress(HilError):
            self.orders.give(Order.RELEASE, "release the arm", 0.5)
            self.variables.release()
        self.beat.end()
        self._hang_up()

    def _hang_up(self) -> None:
        for line in (self._stopping, self._beats, self._main):
            line.close()

    def _device(self) -> str:
        try:
            return self._main.device()
        except HilError:
            return "not told"

    def _take(self, kind: np.dtype[np.void]) -> Beat:
        """Take the arm, and begin with the heartbeat."""
        began = time.monotonic()
        while True:
            try:
                self.orders.give(Order.TAKE, "take the arm")
                break
            except CommandRefused:
                held = self.state()["nSession"] != 0
                allowed = self.watchdog_s + SURE_S if held else TAKE_S
                if time.monotonic() - began > allowed:
                    raise
            except RobotFault as error:
                if time.monotonic() - began > TAKE_S:
                    fault = self.fault(self.state())
                    raise RobotFault(f"{self.where}: {fault}", hint=error.hint) from error
            time.sleep(0.05)
        place = self.variables.handle("stBeat")
        beat = Beat(
            lambda session, count: self._beats.write(
                place, np.array([(session, count)], kind).tobytes()
            ),
            self.session,
        )
        beat.start()
        return beat
