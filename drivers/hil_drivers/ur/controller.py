"""One controller as it is listened to: where it is, what it says of itself, its rows."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import HilError, RobotConnectionError, RobotTimeout
from hil.robot import Identity, Limits
from hil_drivers.arm import ReportedLimits
from hil_drivers.network import ip_address_of, once_listening
from hil_drivers.ur.configuration import told_by_primary
from hil_drivers.ur.facts import limits_of
from hil_drivers.ur.faults import occupied
from hil_drivers.ur.options import Options
from hil_drivers.ur.receiver import Receiver
from hil_drivers.ur.rows import PLAYING, program_state, require_source
from hil_drivers.ur.session import Told, require_arm, require_ready, told_by_dashboard

READ_BACK_S = 2.0
KEPT_S = 5.0
"""How much waits to be read before anything was begun and after a stop, by the controller's clock:
nobody wants what the arm did while a plan was made, for minutes. Of a run all is kept [s]."""

LEFT_OVER_S = 1.0
"""How much longer than its watchdog a program may take to end that somebody has left behind, its
arm having come to rest [s]."""

INERTIA_SINCE = (5, 10)


class Controller:
    """Asked once when it is connected to, and listened to from then on. Commands nothing.

    Args:
        model: The arm of the station.
        options: Of the arm.

    Attributes:
        host: Its IP address, once it was found: stops do not wait for a name server.
        receiver: Its rows.
        told: By its dashboard.
        configured: Its joint limits; None when it has not told them, for the reason `untold`.
    """

    def __init__(self, model: str, options: Options) -> None:
        self._model, self._options = model, options
        self.host = options.address
        self.receiver = self._receiver_of(self.host)
        self.told = Told()
        self.configured: ReportedLimits | None = None
        self.untold = "nobody has asked"

    @property
    def identity(self) -> Identity:
        """Which arm it moves, by which software."""
        version, options = self.receiver.version, self._options
        takes = version[:2] >= INERTIA_SINCE
        details = {
            "address": options.address,
            "torque_source": options.torque_source,
            "moves": options.moves,
            "polyscope": self.told.polyscope,
            "payload_inertia": "declared" if takes else "not declared: software before 5.10",
            "not_sent": ", ".join(self.receiver.missing),
        }
        return Identity(self._model, self.told.serial, ".".join(map(str, version)), "ur", details)

    @property
    def limits(self) -> Limits:
        """The maker's, or the controller's own where those are stricter and known."""
        return limits_of(self._model, self._options, self.configured)

    @property
    def row(self) -> Any:
        """The newest raw row.

        Raises:
            RobotTimeout: There is none.
        """
        newest = self.receiver.newest
        if newest is None:
            raise RobotTimeout("the controller has not said anything yet", hint="connect again")
        return newest[0]

    @property
    def believed(self) -> Payload:
        """The load it believes in."""
        row = self.row
        x, y, z = (float(value) for value in row["payload_cog"])
        inertia: Any = (0.0,) * 6
        if "payload_inertia" in (row.dtype.names or ()):
            inertia = tuple(float(value) for value in row["payload_inertia"])
        return Payload(float(row["payload"]), (x, y, z), inertia)

    def open(self) -> None:
        """Connect, and make sure that its arm may be moved by us.

        Raises:
            RobotConnectionError: Nobody is there, or it is another arm.
            RobotFault: The arm is not in a state in which it may be moved, or somebody moves it.
            SpecError: It does not send what shall be the effort.
        """
        self._find()
        self.told = once_listening(self.host, lambda: told_by_dashboard(self.host))
        self._open_receiver()
        self._require_arm()
        self._ask_limits()
        row = self._row_once_idle()
        require_ready(self.host, self._model, self.told, self.receiver.version, row)

    def listen(self) -> None:
        """Connect to be told.

        Raises:
            RobotConnectionError: Nobody is there, or it is another arm.
            SpecError: It does not send what shall be the effort.
        """
        self._find()
        self._open_receiver()
        with contextlib.suppress(RobotConnectionError):  # RTDE alone will do for listening
            self.told = told_by_dashboard(self.host)
        self._require_arm()

    def forget_rows(self) -> None:
        """Let go of what came before our program played; from now on all is told."""
        until = time.monotonic() + READ_BACK_S
        while time.monotonic() < until:
            if program_state(self.receiver.take(READ_BACK_S))[-1] == PLAYING:
                break
        self.receiver.keep(KEPT_S)

    def close(self) -> None:
        """End the connection. Idempotent."""
        self.receiver.close()

    def _find(self) -> None:
        self.receiver.close()
        self.host = ip_address_of(self._options.address)
        self.receiver = self._receiver_of(self.host)

    def _receiver_of(self, host: str) -> Receiver:
        return Receiver(host, self._options.frequency_hz)

    def _open_receiver(self) -> None:
        once_listening(self.host, self.receiver.open)

    def _require_arm(self) -> None:
        require_source(self._options.torque_source, self.receiver.missing)
        require_arm(self.host, self._model, self.told, self.receiver.version)

    def _ask_limits(self) -> None:
        """Not to know them keeps nobody from connecting, but a run from beginning."""
        self.configured, self.untold = None, ""
        try:
            self.configured = told_by_primary(self.host)
        except HilError as error:
            self.untold = error.message

    def _row_once_idle(self) -> np.void:
        """The newest row; what a session of ours that has died left behind ends by its watchdog."""
        until = time.monotonic() + 1.0 / self._options.watchdog_hz + LEFT_OVER_S
        row: np.void = self.receiver.take(READ_BACK_S)[-1]
        while occupied(row) and time.monotonic() < until:
            row = self.receiver.take(READ_BACK_S)[-1]
        return row
