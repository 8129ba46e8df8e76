"""The mock UR controller: a controller on loopback sockets, with a simulated arm behind it.

`main` runs it as a process (`hil mock ur`); `loop_of` puts the parts together: the machine, what it
listens on, faults, side channel and journal.
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
tell fault protective_stop        something goes wrong: see docs/reference/mock-ur-faults.md
tell fault silence for_s=2
tell clear                        what lasts is over
tell state                        where the arm is, modes, program, faults
tell pendant unlock               releases a protective stop, 5 s of device time after it
tell pendant release_emergency_stop
tell pendant brake_release        switches the arm on first, where it is off
""",
    places={
        "--address": (str, "of the mock (default: 127.0.0.1)"),
        "--side-port": (int, "(default: 30100)"),
    },
    elsewhere="is it another --address or --side-port?",
    main_keys={"fault": "kind", "pendant": "press", "speed": "factor", "step": "ticks"},
)


def main(arguments: Sequence[str] | None = None, *, prog: str = "", seed: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    Args:
        arguments: Of the command line, by default this process's.
        prog: Command by which it was started, for its help.
        seed: Default individual.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    return exit_code_of(lambda: _tell(given) if given.command == "tell" else _run(given))


def parser_of(prog: str = "", seed: int = 1) -> Parser:
    """The command line of `hil mock ur` and `python -m hil_mock_robot ur`."""
    parser = Parser(
        "ur", prog, "A UR controller on loopback sockets, with a simulated arm behind it."
    )
    add = parser.add_argument
    where = "loopback address; ports are a UR controller's and cannot be chosen, so a second mock "
    add("--address", default="127.0.0.1", help=where + "takes another one, such as 127.0.0.2")
    add("--speed", default="1", help="device seconds per second, `free`, or `lock-step`")
    parser.add_arm("ur5", CB3.arms + E_SERIES.arms, seed)
    ranges = "joint range of the safety settings, for all joints; the arm's own without"
    add("--joint-range-deg", type=float, nargs=2, metavar=("LEAST", "MOST"), help=ranges)
    speed = "joint speed of the safety settings, for all joints; the arm's own without"
    add("--joint-speed-deg-s", type=float, metavar="SPEED", help=speed)
    add("--serial", default="", help="digits; by default made of model and seed")
    add("--off", action="store_true", help="start with the arm switched off")
    add("--local", action="store_true", help="start in local control (e-Series)")
    add("--side-port", type=int, default=30100, help="side channel for tests, 0 for none")
    parser.add_records()
    TELL.add_to(parser)
    return parser


def _tell(given: argparse.Namespace) -> int:
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
        SpecError: The file of faults cannot be used.
        RobotConnectionError: The journal cannot be written.
        PluginError: A port is taken.
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
    """The controller and its arm as the command line describes them."""
    maker = published(given.model)
    q = pose_of(given.start_q_deg or upright_deg(maker), maker)
    body = Body(truth_of(given), series.rate_hz, q, mounted=mounted_of(given.mounted_kg))
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


def serial_of(given: str) -> str:
    """Return the serial number of the command line, if controllers can have it.

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
