"""`python -m hil_mock_robot plc`: the mock PLC as a process."""

from __future__ import annotations

import argparse
import signal
import zlib
from collections.abc import Sequence
from typing import Any

from hil.arms import Payload
from hil.core import SpecError
from hil_mock_robot.plant.truth import draw_truth, published
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.journal import Journal
from hil_mock_robot.server.options import exit_code_of, factor_of, loopback_of
from hil_mock_robot.twincat.ads import Links, PlcHandler
from hil_mock_robot.twincat.arm import PlcArm
from hil_mock_robot.twincat.faults import PlcFault, Target
from hil_mock_robot.twincat.loop import Loop
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.options import (
    OWN_COMMAND,
    RATE_HZ,
    STOP_RAD_S2,
    parser_of,
    pose_of,
)
from hil_mock_robot.twincat.program import PlcProgram
from hil_mock_robot.twincat.side import SideFile
from hil_mock_robot.twincat.witness import Witness

CYCLE_S = 1.0 / RATE_HZ
TEMPERATURES, EFFORT_TARGETS = 1, 2
"""Bits of `nOffers`."""


def main(arguments: Sequence[str] | None = None, *, prog: str = OWN_COMMAND, seed: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    Args:
        arguments: Of the command line, by default this process's.
        prog: What it was started as, for its help.
        seed: Which individual when nobody says.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    return exit_code_of(lambda: _run(given))


def _run(given: argparse.Namespace) -> int:
    address, factor = loopback_of(given.address), factor_of(given.speed)
    if factor is None:
        raise SpecError(f"--speed {given.speed} is for the UR mock", hint="give a number")
    loop = loop_of(given, address, factor)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: loop.end())
    print(  # noqa: T201
        f"ready: {given.model} behind a PLC on {address}, AMS {address}.1.1:{given.ams_port}, "
        f"×{factor:g}",
        flush=True,
    )
    loop.run()
    return 0


def loop_of(given: argparse.Namespace, address: str, factor: float) -> Loop:
    """The PLC on its port, with what goes wrong and who writes it down.

    Raises:
        SpecError: The file of faults cannot be used, or the pose is none.
        RobotConnectionError: The journal cannot be written.
        PluginError: The port is taken.
    """
    journal = Journal(str(given.journal) if given.journal else None, address)
    journal.open()
    witness = Witness(journal, CYCLE_S)
    memory, arm = Memory(given.without), arm_of(given)
    fill_info(memory, arm, given)
    program = PlcProgram(memory, arm)
    handler = PlcHandler(memory, given.ams_port)
    links = Links(address, handler)
    planned = PlcFault.read(given.faults) if given.faults else ()
    faults = Faults(Target(program, handler, links), PlcFault, CYCLE_S, planned)

    def count_motions(event: str, details: dict[str, Any]) -> None:
        if event == "start" and details["by"] == "start":
            faults.began("motion")

    program.listeners += [witness.happened, count_motions]
    side = SideFile(given.side) if given.side else None
    return Loop(program, links, faults, witness, cycle_s=CYCLE_S, factor=factor, side=side)


def arm_of(given: argparse.Namespace) -> PlcArm:
    """The arm as the command line describes it."""
    truth = draw_truth(given.model, given.seed, given.profile)
    if given.truth:
        truth.to_json(given.truth)
    mounted = None
    if given.mounted_kg:
        mass, x, y, z = given.mounted_kg
        mounted = Payload(mass, (x, y, z))
    q = pose_of(given.start_q_deg, published(given.model))
    return PlcArm(truth, RATE_HZ, q, torque=given.effort == "torque", mounted=mounted)


def fill_info(memory: Memory, arm: PlcArm, given: argparse.Namespace) -> None:
    """What the PLC says about itself."""
    info, maker = memory.view("stInfo")[0], arm.published
    info["fCycleS"], info["fWatchdogS"] = CYCLE_S, given.watchdog_s
    info["fStopRadS2"], info["fPayloadMax"] = STOP_RAD_S2, maker.payload_max_kg
    info["aQMin"], info["aQMax"] = maker.q_min, maker.q_max
    info["aQdMax"], info["aQddMax"] = maker.qd_max, maker.qdd_max
    if given.contract is not None:
        memory.view("nContract")[0] = given.contract
    info["nAxes"] = maker.n_joints
    info["nRingRows"] = len(memory.view("aRing"))
    info["nSetPoints"] = len(memory.view("aSetPoints"))
    info["nEffort"] = 1 if given.effort == "torque" else 2
    info["nOffers"] = TEMPERATURES | EFFORT_TARGETS
    info["sModel"], info["sProgram"] = given.model.encode(), b"hil mock plc 1"
    made = f"{given.model} {given.seed} {given.profile}".encode()
    info["sSerial"] = (given.serial or f"PLC{zlib.crc32(made) % 1_000_000:06d}").encode()
