"""What the mock drives are started with."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hil.arms import ArmDescription, Payload, arm_names
from hil.core import FloatArray, SpecError
from hil_mock_robot.cia402.station import PATIENCE_S
from hil_mock_robot.cia402.telling import add_tell
from hil_mock_robot.server.options import WithDefaults

OWN_COMMAND = "python -m hil_mock_robot can"
MODEL, CHANNEL, INTERFACE, MASTER_ID = "lab6", "can0", "hil_unix", 127
MOST_NODE = 127
NO_SIDE = "none"


def parser_of(prog: str = OWN_COMMAND, seed: int = 1) -> argparse.ArgumentParser:
    """The command line of `hil mock can` and `python -m hil_mock_robot can`.

    Args:
        prog: What it was started as.
        seed: Which individual, by default.
    """
    parser = argparse.ArgumentParser(
        prog=prog,
        formatter_class=WithDefaults,
        description="CiA 402 drives on a CAN bus, with a simulated arm between them. They are "
        "there when it says `ready`, until Ctrl-C.",
    )
    add = parser.add_argument
    channel = "of the bus: a name, or the path of its socket; a second mock takes another one"
    add("--channel", default=CHANNEL, help=channel)
    interface = f"{INTERFACE}: the mock hosts the bus; else an interface of python-can"
    add("--interface", default=INTERFACE, help=interface)
    rate = f"of the bus [bit/s]; on {INTERFACE} the wire is modelled with it, without it is not"
    add("--bitrate", type=float, metavar="BIT_S", help=rate)
    wire = "seconds of the modelled wire in one of the clock: the `pace` of the master; 1 without"
    add("--wire-speed", type=float, metavar="FACTOR", help=wire)
    add("--model", default=MODEL, choices=arm_names(), help="of the arm")
    add("--seed", type=int, default=seed, help="which individual")
    add("--profile", default="full", choices=("full", "ideal"), help="of the physics")
    start = "where the arm stands at first, joint by joint; all zeros without"
    add("--start-q-deg", type=float, nargs="+", default=(), metavar="Q", help=start)
    hangs = "what really hangs at the flange, whatever is declared: mass and centre [m]"
    add("--mounted-kg", type=float, nargs=4, metavar=("KG", "X", "Y", "Z"), help=hangs)
    add("--nodes", type=int, nargs="+", default=(), metavar="ID", help="node ids; 1, 2 … without")
    announces = "node id under which the master announces what it does"
    add("--master-id", type=int, default=MASTER_ID, metavar="ID", help=announces)
    patience = "wall time without SYNC after which the drives go by their own timer"
    add("--sync-patience-s", type=float, default=PATIENCE_S, metavar="S", help=patience)
    side = f"socket of the side channel for tests, `{NO_SIDE}` for none; beside the bus without"
    add("--side", default="", metavar="PATH", help=side)
    add("--faults", type=Path, help="YAML file: what goes wrong, and when")
    add("--journal", type=Path, help="file for what they were told and what they did")
    truth = "write every true parameter to this file, for scoring"
    add("--truth", type=Path, help=truth if prog == OWN_COMMAND else f"{truth}, and start nothing")
    add("--eds", type=Path, help="write the drives' electronic data sheet (EDS), and stop")
    add_tell(parser)
    return parser


def nodes_of(given: Sequence[int], arm: ArmDescription, master_id: int) -> tuple[int, ...]:
    """Node id of each axis.

    Raises:
        SpecError: They cannot be.
    """
    nodes = tuple(given) or tuple(range(1, arm.n_joints + 1))
    if len(nodes) != arm.n_joints:
        raise SpecError(
            f"--nodes names {len(nodes)} drives, the arm {arm.name} has {arm.n_joints} joints",
            hint="give one node id per joint, from the base on",
        )
    if len({*nodes, master_id}) != len(nodes) + 1 or not all(
        1 <= node <= MOST_NODE for node in (*nodes, master_id)
    ):
        raise SpecError(
            f"--nodes {list(nodes)} and --master-id {master_id} cannot be on one bus",
            hint=f"give different numbers from 1 to {MOST_NODE}",
        )
    return nodes


def pose_of(degrees: Sequence[float], arm: ArmDescription) -> FloatArray:
    """(n,) in radians.

    Raises:
        SpecError: It is no pose of the arm.
    """
    if not degrees:
        return np.zeros(arm.n_joints)
    q: FloatArray = np.radians(np.asarray(degrees, dtype=float))
    if q.shape != (arm.n_joints,) or not ((arm.q_min <= q) & (q <= arm.q_max)).all():
        raise SpecError(
            f"--start-q-deg {list(degrees)} is no pose of {arm.name}",
            hint=f"give {arm.n_joints} angles within the joints' range: "
            f"{np.degrees(arm.q_min).round()} to {np.degrees(arm.q_max).round()}",
        )
    return q


def mounted_in(given: Sequence[float] | None) -> Payload | None:
    """What really hangs at the flange; None for what is declared.

    Raises:
        SpecError: It is no body.
    """
    if not given:
        return None
    mass, x, y, z = given
    if not (mass >= 0 and np.isfinite(given).all()):
        raise SpecError(f"--mounted-kg {list(given)}", hint="give a mass ≥ 0 and a centre [m]")
    return Payload(mass, (x, y, z))
