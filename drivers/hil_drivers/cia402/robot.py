"""Driver of an arm on CiA 402 drives: a process of its own owns the bus and its clock.

Neither process can delay the other: `AxesRobot` exchanges cycles in its own process, `Cia402Robot`
passes calls on to it. If that process does not stop the arm, `Cia402Robot` sends the stop to the
drives itself.
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
"""How long its process may take to confirm a stop; then the drives are stopped directly [s]."""


class Cia402Robot(RobotProcess):
    """Implements `hil.robot.Robot` for six drives, or as many as the arm has joints.

    Args:
        name: The robot's name in its station.
        model: A built-in arm.
        options: See `hil_drivers.cia402.options.Options`.

    Raises:
        SpecError: An option is missing, unknown, or cannot be.
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
        """See `hil.robot.HasReach`."""
        return [self._options.bus.finding()]

    @classmethod
    def read_log(
        cls, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> RecordedLog:
        """See `hil.robot.protocol.ReadsLogs`."""
        return Replay(log, model, options, robot)

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set gravity in the base frame [m/s²] for the torque model; call before `connect`."""
        self._how["gravity"] = list(gravity_m_s2)

    def connect(self) -> None:
        """See `hil.robot.Robot`; once connected, limits and gains are those of the drives."""
        # A stop has milliseconds: too little to import this then. Where it is not installed, the
        # process that joins the bus says so.
        with contextlib.suppress(ImportError):
            import can  # noqa: F401

        super().connect()

    def stop(self) -> None:
        """Bring the arm to rest: by its process, else by stopping the drives directly.

        Raises:
            RobotConnectionError: Neither way works.
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
                    f"{self._name}: nobody can tell the drives to stop ({error.message}); they "
                    "stop by themselves when the master's heartbeat is overdue, after 0.25 s",
                    hint="see to the robot itself, by its emergency stop if need be",
                ) from error
