"""Driver of an arm on CiA 402 drives; a separate process owns the bus and its clock.

`AxesRobot` executes the cycles in the separate process, and `Cia402Robot` forwards calls to that
process. Because of the separate process, the caller and the cycles cannot delay each other. If the
separate process does not stop the arm, `Cia402Robot` sends the stop to the drives directly.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.core import RobotConnectionError, RobotTimeout
from hil.robot import Facts, Finding, RecordedLog, RobotProcess
from hil_drivers.arm import capabilities_of, limits_of
from hil_drivers.cia402.can_cycle import stop_directly
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.replay import Replay
from hil_drivers.cia402.rows import raw_topic

DRIVER = "hil_drivers.cia402.axes_robot:AxesRobot"

STOP_S = 0.06
"""Longest wait for the driver process to confirm a stop [s].

If the driver process does not confirm a stop in this time, the drives are stopped directly.
"""


class Cia402Robot(RobotProcess):
    """Implementation of `hil.robot.Robot` for an arm with one CiA 402 drive per joint.

    Args:
        name: Name of the robot in its station.
        model: Name of a built-in arm.
        options: Options of the station, as described in `hil_drivers.cia402.options.Options`.

    Raises:
        SpecError: An option of the station is missing, unknown or invalid.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        own = self._options = options_of(options, model)
        capabilities = capabilities_of(model, own.rate_hz, own.effort)
        n, rate_hz = len(capabilities.joint_names), capabilities.rate_hz
        known = Facts(
            capabilities=capabilities,
            limits=limits_of(model),
            topics=(raw_topic(MAPPINGS[own.mapping], n, rate_hz),),
            resource=own.resource,
            identity=None,
            checks=True,
            address=own.address,
        )
        super().__init__(DRIVER, name, model, options, known=known)

    def reach(self) -> Sequence[Finding]:
        """Return whether the bus can be reached; see `hil.robot.HasReach`."""
        return [self._options.bus.finding()]

    @classmethod
    def read_log(
        cls, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> RecordedLog:
        """Open the log of a run; see `hil.robot.protocol.ReadsLogs`."""
        return Replay(log, model, options, robot)

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set the gravity vector of the torque model [m/s², base frame]; call before `connect`."""
        self._how["gravity"] = list(gravity_m_s2)

    def connect(self) -> None:
        """Connect the drives; afterwards `limits` and `capabilities` are those of the drives."""
        # Imported now, because a stop must not take longer than milliseconds. If the package is
        # missing, the process that opens the bus reports it.
        with contextlib.suppress(ImportError):
            import can  # noqa: F401

        super().connect()

    def stop(self) -> None:
        """Stop the arm by the driver process; if that fails, stop the drives directly.

        Raises:
            RobotConnectionError: The arm could be stopped neither by the driver process nor
                directly.
        """
        self._last_stop = object()
        process = self.process
        if process is None:
            return
        try:
            process.stop(STOP_S)
        except (RobotConnectionError, RobotTimeout) as error:
            if not stop_directly(self._options):
                raise RobotConnectionError(
                    f"{self._name}: no stop can be sent to the drives ({error.message}); they stop "
                    "by themselves when the heartbeat of the master is overdue, after 0.25 s",
                    hint="check that the robot stops; if not, press its emergency stop",
                ) from error
