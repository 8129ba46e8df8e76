"""What the mock PLC is started with."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, SpecError
from hil_mock_robot.embedded.options import UPRIGHT_DEG
from hil_mock_robot.server.options import WithDefaults

OWN_COMMAND = "python -m hil_mock_robot plc"
RATE_HZ = 1000.0
WATCHDOG_S, STOP_RAD_S2 = 0.3, 8.0


def parser_of(prog: str = OWN_COMMAND, seed: int = 1) -> argparse.ArgumentParser:
    """The command line of `hil mock plc` and `python -m hil_mock_robot plc`.

    Args:
        prog: What it was started as.
        seed: Which individual, by default.
    """
    parser = argparse.ArgumentParser(
        prog=prog,
        formatter_class=WithDefaults,
        description="A PLC that plays trajectories, on a loopback port for ADS, with a simulated "
        "arm behind it. It is there when it says `ready`, until Ctrl-C.",
    )
    add = parser.add_argument
    where = "loopback address; the port is 48898, so a second mock takes another one"
    add("--address", default="127.0.0.1", help=where)
    add("--ams-port", type=int, default=851, help="of the PLC's runtime")
    add("--model", default="lab6", help="built-in arm")
    add("--seed", type=int, default=seed, help="which individual")
    add("--profile", default="full", choices=("full", "ideal"), help="of the physics")
    add("--speed", default="1", help="device seconds per second, 0.01 to 1000")
    add("--effort", default="torque", choices=("torque", "current"), help="what drives tell")
    add("--start-q-deg", type=float, nargs="+", help="where the arm stands (default: upright)")
    hangs = "what really hangs at the flange (default: what is declared)"
    add("--mounted-kg", type=float, nargs=4, metavar=("KG", "X", "Y", "Z"), help=hangs)
    add("--serial", default="", help="of the PLC (default: made of model and seed)")
    add("--watchdog-s", type=float, default=WATCHDOG_S, help="silence that stops the arm, wall")
    add("--contract", type=int, help="version that it says to have (default: the true one)")
    add("--without", action="append", default=[], metavar="NAME", help="a variable it lacks")
    add("--faults", type=Path, help="YAML file: what goes wrong, and when")
    add("--side", type=Path, help="file whose lines are requests: see the documentation")
    add("--journal", type=Path, help="file for what it was told and what it did")
    truth = "write every true parameter to this file, for scoring"
    add("--truth", type=Path, help=truth if prog == OWN_COMMAND else f"{truth}, and start nothing")
    return parser


def pose_of(degrees: Sequence[float] | None, arm: ArmDescription) -> FloatArray:
    """(n,) where the arm stands at first [rad]: by default as the embedded mock does.

    Raises:
        SpecError: It is no pose of this arm.
    """
    upright = UPRIGHT_DEG.get(arm.name[:2], (0.0,) * arm.n_joints)
    q: FloatArray = np.radians(np.asarray(upright if degrees is None else degrees, dtype=float))
    if q.shape != arm.q_min.shape or not ((q >= arm.q_min) & (q <= arm.q_max)).all():
        raise SpecError(
            f"--start-q-deg {degrees}: no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits",
        )
    return q
