"""`python -m hil_mock_robot ur`: the mock UR controller as a process."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import zlib
from collections.abc import Sequence

from hil.arms import Payload
from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.server.journal import Journal
from hil_mock_robot.server.options import exit_code_of, factor_of, loopback_of
from hil_mock_robot.ur.body import Body
from hil_mock_robot.ur.faults import UrFault, UrFaults
from hil_mock_robot.ur.loop import FreeRun, LockStep, Loop, Pacer, RealTime, SlipWarning
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.options import (
    OWN_COMMAND,
    narrowed,
    parser_of,
    pose_of,
    serial_of,
)
from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.services import services_of
from hil_mock_robot.ur.side import SideService
from hil_mock_robot.ur.telling import request_of, tell
from hil_mock_robot.ur.variables import Series, series_of
from hil_mock_robot.ur.witness import Witness


def main(arguments: Sequence[str] | None = None, *, prog: str = OWN_COMMAND, seed: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    Args:
        arguments: Of the command line, by default this process's.
        prog: What it was started as, for its help.
        seed: Which individual when nobody says.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    do = _tell if given.command == "tell" else _run
    return exit_code_of(lambda: do(given))


def _tell(given: argparse.Namespace) -> int:
    request = request_of(given.request, given.more)
    answer = tell(given.address, given.side_port, request)
    print(json.dumps(answer), flush=True)  # noqa: T201
    return 0


def _run(given: argparse.Namespace) -> int:
    address = loopback_of(given.address)
    series = series_of(given.model)
    pacer = pacer_of(given.speed, series)
    machine = machine_of(given, series)
    machine.mishaps.contained = True
    loop = loop_of(given, machine, pacer, address)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: loop.end())
    version = ".".join(map(str, series.version[:3]))
    speed = given.speed if factor_of(given.speed) is None else f"×{factor_of(given.speed):g}"
    print(f"ready: {given.model}, software {version}, on {address}, {speed}", flush=True)  # noqa: T201
    loop.run()
    return 0


def loop_of(given: argparse.Namespace, machine: Machine, pacer: Pacer, address: str) -> Loop:
    """The controller on its ports, with what goes wrong and who writes it down.

    Raises:
        SpecError: The file of faults cannot be used.
        RobotConnectionError: The journal cannot be written.
        PluginError: A port is taken.
    """
    services = services_of(machine)
    owners = next((each.owners for each in services if isinstance(each, RtdeService)), None)
    planned = UrFault.read(given.faults) if given.faults else ()
    machine.line.random.seed(given.seed)
    faults = UrFaults(machine, planned, owners)
    witness = None
    if given.journal:
        journal = Journal(str(given.journal), address)
        journal.open()
        witness = Witness(machine, journal)
        faults.listeners.append(witness.struck)
    if isinstance(pacer, RealTime):
        pacer.listeners.append(SlipWarning(_warn).slipped)
        pacer.listeners += [witness.slipped] if witness else []
    side = SideService(given.side_port, machine, faults, pacer) if given.side_port else None
    return Loop(machine, services, pacer, address, faults=faults, witness=witness, side=side)


def _warn(line: str) -> None:
    print(line, file=sys.stderr, flush=True)  # noqa: T201


def machine_of(given: argparse.Namespace, series: Series) -> Machine:
    """The controller and its arm as the command line describes them."""
    truth = draw_truth(given.model, given.seed, given.profile)
    if given.truth:
        truth.to_json(given.truth)
    mounted = None
    if given.mounted_kg:
        mass, x, y, z = given.mounted_kg
        mounted = Payload(mass, (x, y, z))
    body = Body(truth, series.rate_hz, pose_of(given.start_q_deg), mounted=mounted)
    if given.joint_range_deg or given.joint_speed_deg_s is not None:
        body.arm = narrowed(body.arm, given.joint_range_deg, given.joint_speed_deg_s)
    serial = serial_of(given.serial) or _made_serial(given)
    machine = Machine(series, body, serial=serial, powered=not given.off)
    machine.modes.remote = not given.local
    return machine


def pacer_of(speed: str, series: Series) -> Pacer:
    """How time passes.

    Raises:
        SpecError: There is no such speed.
    """
    factor = factor_of(speed)
    if factor is not None:
        return RealTime(1.0 / series.rate_hz, factor)
    return FreeRun() if speed == "free" else LockStep()


def _made_serial(given: argparse.Namespace) -> str:
    """Digits as UR's serial numbers are: the year, the size of the arm, which one."""
    size = "".join(c for c in given.model if c.isdigit())
    individual = zlib.crc32(f"{given.model} {given.seed} {given.profile}".encode()) % 1_000_000
    return f"2022{size:0>2}{individual:06d}"
