"""What there is between joining the bus and leaving it, beside the drives themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.robot import Topic
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.samples import Samples
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.thermometer import Thermometer
from hil_drivers.cia402.torque_check import require_plausible
from hil_drivers.cia402.torque_model import TorqueModel
from hil_drivers.cia402.track import Track
from hil_drivers.cia402.trouble import Trouble


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """What an arm has while it is connected.

    Attributes:
        session: To the drives.
        samples: Of their cycles.
        trouble: What is wrong with them.
        thermometer: Asks them beside the cycles.
        torque: The model, where drives are told torques.
    """

    session: Session
    samples: Samples
    trouble: Trouble
    thermometer: Thermometer
    torque: TorqueModel | None

    def look(self) -> None:
        """Before torques are sent: those that the drives measure have to hold the arm.

        Raises:
            RobotConnectionError: They cannot be what holds it.
        """
        if self.torque is not None:
            require_plausible(self.session, self.torque)

    def hold_anew(self) -> None:
        """Hold where the arm is, with the torques that its new load takes.

        Raises:
            CommandRefused: It moves.
        """
        if self.torque is None:
            return
        player, scaling = self.session.player, self.session.drives.scaling
        held = np.array([player.position])
        torque = scaling.raw_torque(self.torque.holding(scaling.position(held)))
        self.session.core.prepare(Track(player.segment, held, np.zeros_like(held), torque))
        self.session.core.start()


def line_to(
    name: str, model: str, options: Options, topic: Topic, gravity: tuple[float, float, float]
) -> Line:
    """Join the bus and set all drives up; nothing moves, no axis is enabled yet.

    Args:
        name: Of the robot.
        model: Built-in arm.
        options: Of the station.
        topic: Of the raw rows.
        gravity: (3,) in the base frame [m/s²], for the torque model.

    Raises:
        HilError: See `Session`; `SpecError` when the torque model cannot be used.
    """
    needed = options.feed_forward or options.trajectory_mode == "cst"
    torque = TorqueModel(model, options.urdf, gravity) if needed else None
    session = Session(model, options)
    samples = Samples(session, topic)
    at_once, n = session.acyclic.at_once, len(options.nodes)
    thermometer = Thermometer(at_once, options.temperature_object, n)
    return Line(session, samples, Trouble(name, session, samples), thermometer, torque)
