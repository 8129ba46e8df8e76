"""What the mock UR controller is started with."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, SpecError
from hil_mock_robot.server.options import WithDefaults
from hil_mock_robot.ur.telling import add_tell
from hil_mock_robot.ur.variables import CB3, E_SERIES

OWN_COMMAND = "python -m hil_mock_robot ur"
UPRIGHT_DEG = (0.0, -90.0, 0.0, -90.0, 0.0, 0.0)


def parser_of(prog: str = OWN_COMMAND, seed: int = 1) -> argparse.ArgumentParser:
    """The command line of `hil mock ur` and `python -m hil_mock_robot ur`.

    Args:
        prog: What it was started as.
        seed: Which individual, by default.
    """
    parser = argparse.ArgumentParser(
        prog=prog,
        formatter_class=WithDefaults,
        description="A UR controller on loopback sockets, with a simulated arm behind it. It is "
        "there when it says `ready`, until Ctrl-C.",
    )
    add = parser.add_argument
    where = "loopback address; ports are a UR controller's and cannot be chosen, so a second mock "
    add("--address", default="127.0.0.1", help=where + "takes another one, such as 127.0.0.2")
    add("--model", default="ur5", choices=CB3.arms + E_SERIES.arms, help="ur5: CB3, ur5e: e-Series")
    add("--seed", type=int, default=seed, help="which individual")
    add("--profile", default="full", choices=("full", "ideal"), help="of the physics")
    add("--speed", default="1", help="device seconds per second, `free`, or `lock-step`")
    start = "where the arm stands at first, joint by joint; upright without"
    add("--start-q-deg", type=float, nargs=6, default=UPRIGHT_DEG, metavar="Q", help=start)
    ranges = "joint range of the safety settings, for all joints; the arm's own without"
    add("--joint-range-deg", type=float, nargs=2, metavar=("LEAST", "MOST"), help=ranges)
    speed = "joint speed of the safety settings, for all joints; the arm's own without"
    add("--joint-speed-deg-s", type=float, metavar="SPEED", help=speed)
    hangs = "what really hangs at the flange, whatever is declared: mass and centre [m]"
    add("--mounted-kg", type=float, nargs=4, metavar=("KG", "X", "Y", "Z"), help=hangs)
    add("--serial", default="", help="digits; by default made of model and seed")
    add("--off", action="store_true", help="start with the arm switched off")
    add("--local", action="store_true", help="start in local control (e-Series)")
    add("--side-port", type=int, default=30100, help="side channel for tests, 0 for none")
    add("--faults", type=Path, help="YAML file: what goes wrong, and when")
    add("--journal", type=Path, help="file for what it was told and what it did")
    truth = "write every true parameter to this file, for scoring"
    add("--truth", type=Path, help=truth if prog == OWN_COMMAND else f"{truth}, and start nothing")
    add_tell(parser)
    return parser


def serial_of(given: str) -> str:
    """A serial number that was asked for, if controllers have such ones.

    Raises:
        SpecError: `ur-rtde` and others read a number and refuse what is none.
    """
    if given and not (given.isascii() and given.isdigit()):
        raise SpecError(
            f"--serial {given!r}: a UR's serial number has digits only",
            hint="such as --serial 2022050001",
        )
    return given


def narrowed(
    arm: ArmDescription, range_deg: Sequence[float] | None, speed_deg_s: float | None
) -> ArmDescription:
    """The arm with the joint limits of its safety settings, which are never wider than its own.

    Raises:
        SpecError: No joint could move within them.
    """
    least, most = np.radians(range_deg or (-np.inf, np.inf))
    fastest = np.inf if speed_deg_s is None else np.radians(speed_deg_s)
    q_min, q_max = np.maximum(arm.q_min, least), np.minimum(arm.q_max, most)
    if not ((q_min < q_max).all() and fastest > 0):
        raise SpecError(
            f"--joint-range-deg {range_deg}, --joint-speed-deg-s {speed_deg_s}: nothing could move",
            hint="give the smaller number first, and a speed above 0",
        )
    return replace(arm, q_min=q_min, q_max=q_max, qd_max=np.minimum(arm.qd_max, fastest))


def pose_of(degrees: Sequence[float]) -> FloatArray:
    """(6,) in radians.

    Raises:
        SpecError: It is no pose of a UR arm.
    """
    q: FloatArray = np.radians(np.asarray(degrees, dtype=float))
    if not (np.abs(q) <= 2 * np.pi).all():
        raise SpecError(f"--start-q-deg {list(degrees)}: joints turn ±360°", hint="stay inside")
    return q
