"""Mock UR controller: a controller on loopback sockets with a simulated arm.

`main` runs the mock as a process (`hil mock ur`). `loop_of` assembles the parts of the mock:
machine, services, faults, side channel and journal.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hil.arms import ArmDescription
from hil.core import SpecError
from hil_mock_robot.plant.truth import published
from hil_mock_robot.server.cli import Parser, exit_code_of, serve, show, truth_of
from hil_mock_robot.server.journal import journal_of
from hil_mock_robot.server.options import factor_of, loopback_of, mounted_of, pose_of, upright_deg
from hil_mock_robot.server.side_channel import Tell
from hil_mock_robot.ur.body import Body
from hil_mock_robot.ur.client_interfaces import PRIMARY, SECONDARY, PrimaryService, RealtimeService
from hil_mock_robot.ur.connections import Service
from hil_mock_robot.ur.dashboard import DashboardService
from hil_mock_robot.ur.faults import UrFault, UrFaults
from hil_mock_robot.ur.journal import Witness
from hil_mock_robot.ur.loop import Loop
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.pacing import FreeRun, LockStep, Pacer, RealTime, SlipWarning
from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.rtde_variables import CB3, E_SERIES, Series, series_of
from hil_mock_robot.ur.side import SideService

TELL = Tell(
    command="hil mock ur",
    who="mock UR controller answers",
    requests="fault, clear, state, pendant, push, mount, speed or step",
    examples="""\
send fault protective_stop        begin a fault: see docs/reference/mock-ur-faults.md
send fault silence for_s=2
send clear                        end all faults
send state                        true pose, modes, program, faults
send pendant unlock               release a protective stop, 5 s of device time after it
send pendant release_emergency_stop
send pendant brake_release        release the brakes; first switch the arm on if it is off
""",
    places={
        "--address": (str, "address of the mock (default: 127.0.0.1)"),
        "--side-port": (int, "port of the side channel (default: 30100)"),
    },
    elsewhere="or check --address and --side-port",
    main_keys={"fault": "kind", "pendant": "press", "speed": "factor", "step": "ticks"},
)


def main(arguments: Sequence[str] | None = None, *, prog: str = "", seed: int = 1) -> int:
    """Run the mock until SIGINT, SIGTERM or SIGHUP; return the exit code.

    Args:
        arguments: Command-line arguments; None for those of this process.
        prog: Command that started the mock, for its help.
        seed: Default seed for the random parameters of the arm.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    return exit_code_of(lambda: _send(given) if given.command else _run(given))


def parser_of(prog: str = "", seed: int = 1) -> Parser:
    """Return the parser of `hil mock ur` and `python -m hil_mock_robot ur`."""
    parser = Parser("ur", prog, "UR controller on loopback sockets with a simulated arm.")
    add = parser.add_argument
    where = "loopback address; the ports are those of a UR controller, so a second mock "
    add(
        "--address",
        default="127.0.0.1",
        help=where + "needs a different address, such as 127.0.0.2",
    )
    add("--speed", default="1", help="device seconds per second, `free`, or `lock-step`")
    parser.add_arm("ur5", CB3.arms + E_SERIES.arms, seed)
    ranges = "joint range of the safety settings, for all joints; without, the range of the arm"
    add("--joint-range-deg", type=float, nargs=2, metavar=("LEAST", "MOST"), help=ranges)
    speed = "joint speed of the safety settings, for all joints; without, that of the arm"
    add("--joint-speed-deg-s", type=float, metavar="SPEED", help=speed)
    add(
        "--serial",
        default="",
        help="serial number, digits only; by default derived from model and seed",
    )
    add("--off", action="store_true", help="start with the arm switched off")
    add("--local", action="store_true", help="start in local control (e-Series)")
    add(
        "--side-port",
        type=int,
        default=30100,
        help="port of the side channel for tests, 0 for none",
    )
    parser.add_records()
    TELL.add_to(parser)
    return parser


def _send(given: argparse.Namespace) -> int:
    place = given.address, given.side_port
    return show(TELL.ask(place, TELL.request(given.request, given.more)))


def _run(given: argparse.Namespace) -> int:
    address = loopback_of(given.address)
    series = series_of(given.model)
    pacer = pacer_of(given.speed, series)
    machine = machine_of(given, series)
    machine.mishaps.contained = True
    loop = loop_of(given, machine, pacer, address)
    version = ".".join(map(str, series.version[:3]))
    speed = given.speed if factor_of(given.speed) is None else f"×{factor_of(given.speed):g}"
    return serve(loop, f"{given.model}, software {version}, on {address}, {speed}")


def loop_of(given: argparse.Namespace, machine: Machine, pacer: Pacer, address: str) -> Loop:
    """Return the controller on its ports, with faults, journal and side channel.

    Raises:
        SpecError: The file of faults is invalid.
        RobotConnectionError: The journal cannot be written.
        PluginError: A port is in use.
    """
    rtde = RtdeService(machine)
    planned = UrFault.read(given.faults) if given.faults else ()
    machine.line.random.seed(given.seed)
    faults = UrFaults(machine, planned, rtde.owners)
    witness = None
    if given.journal:
        witness = Witness(machine, journal_of(given.journal, address))
        faults.listeners.append(witness.struck)
    if isinstance(pacer, RealTime):
        pacer.listeners.append(SlipWarning(_warn).slipped)
        pacer.listeners += [witness.slipped] if witness else []
    side = SideService(given.side_port, machine, faults, pacer) if given.side_port else None
    return Loop(
        machine,
        services_of(machine, rtde),
        pacer,
        address,
        faults=faults,
        witness=witness,
        side=side,
    )


def services_of(machine: Machine, rtde: RtdeService | None = None) -> list[Service]:
    """Return the services on the ports of a UR controller."""
    return [
        rtde or RtdeService(machine),
        DashboardService(machine),
        PrimaryService(machine, PRIMARY),
        PrimaryService(machine, SECONDARY),
        RealtimeService(machine),
    ]


def _warn(line: str) -> None:
    print(line, file=sys.stderr, flush=True)  # noqa: T201


def machine_of(given: argparse.Namespace, series: Series) -> Machine:
    """Return the controller and its arm according to the command line."""
    maker = published(given.model)
    q = pose_of(given.start_q_deg or upright_deg(maker), maker)
    body = Body(truth_of(given), series.rate_hz, q, mounted=mounted_of(given.mounted_kg))
    if given.joint_range_deg or given.joint_speed_deg_s is not None:
        body.arm = narrowed(body.arm, given.joint_range_deg, given.joint_speed_deg_s)
    serial = serial_of(given.serial) or _derived_serial(given)
    machine = Machine(series, body, serial=serial, powered=not given.off)
    machine.modes.remote = not given.local
    return machine


def pacer_of(speed: str, series: Series) -> Pacer:
    """Return the pacer for a speed of the command line.

    Raises:
        SpecError: The speed is invalid.
    """
    factor = factor_of(speed)
    if factor is not None:
        return RealTime(1.0 / series.rate_hz, factor)
    return FreeRun() if speed == "free" else LockStep()


def _derived_serial(given: argparse.Namespace) -> str:
    """Return a serial number in UR's format: year, size of the arm, number of the individual."""
    size = "".join(c for c in given.model if c.isdigit())
    individual = zlib.crc32(f"{given.model} {given.seed} {given.profile}".encode()) % 1_000_000
    return f"2022{size:0>2}{individual:06d}"


def serial_of(given: str) -> str:
    """Return the serial number of the command line if it is valid.

    Raises:
        SpecError: The serial number is not numeric; `ur-rtde` and other clients read a number.
    """
    if given and not (given.isascii() and given.isdigit()):
        raise SpecError(
            f"--serial {given!r}: a UR serial number has only digits",
            hint="give digits, such as --serial 2022050001",
        )
    return given


def narrowed(
    arm: ArmDescription, range_deg: Sequence[float] | None, speed_deg_s: float | None
) -> ArmDescription:
    """Return the arm with the joint limits of its safety settings, within the arm's own limits.

    Raises:
        SpecError: The range of a joint is empty, or the speed is not positive.
    """
    least, most = np.radians(range_deg or (-np.inf, np.inf))
    fastest = np.inf if speed_deg_s is None else np.radians(speed_deg_s)
    q_min, q_max = np.maximum(arm.q_min, least), np.minimum(arm.q_max, most)
    if not ((q_min < q_max).all() and fastest > 0):
        raise SpecError(
            f"--joint-range-deg {range_deg}, --joint-speed-deg-s {speed_deg_s}: no motion possible",
            hint="give the smaller number first, and a speed above 0",
        )
    return replace(arm, q_min=q_min, q_max=q_max, qd_max=np.minimum(arm.qd_max, fastest))
