"""Mock PLC: a TwinCAT PLC with the ADS contract of `hil` and a simulated arm.

`main` runs the mock as a process (`hil mock plc`). `loop_of` assembles the parts of the mock:
memory and program of the PLC, ADS server, faults, side channel and journal. Device time follows the
wall clock, multiplied by a factor.
"""

from __future__ import annotations

import argparse
import time
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, SpecError
from hil_mock_robot.plant.truth import published
from hil_mock_robot.server import journal, loop
from hil_mock_robot.server.cli import Parser, exit_code_of, serve, show, truth_of
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.journal import Journal, Moment, journal_of
from hil_mock_robot.server.options import (
    factor_of,
    loopback_of,
    mounted_of,
    pose_of,
    upright_deg,
)
from hil_mock_robot.server.side_channel import (
    NO_SIDE,
    Answer,
    Request,
    Requests,
    SideChannel,
    Tell,
    factor_in,
    listed,
    usual_path,
)
from hil_mock_robot.twincat.ads import Links, PlcHandler
from hil_mock_robot.twincat.arm import PlcArm
from hil_mock_robot.twincat.faults import PlcFault, Target
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.program import PlcProgram

RATE_HZ = 1000.0
CYCLE_S = 1.0 / RATE_HZ
AMS_PORT = 851
"""AMS port of the runtime of a PLC's first program."""

WATCHDOG_S = 0.3
"""Silence of the client in wall time after which the arm is stopped [s]."""

STOP_RAD_S2 = 8.0
TEMPERATURES, EFFORT_TARGETS = 1, 2
"""Bits of `nOffers`."""

ROUND_S = 0.004
"""Wall time between two readings of the clock; cycles are executed in blocks of this duration
[s].
"""

LATEST_S = 0.05
"""Delay in wall time [s] above which the missed time is not caught up.

The silence of the PC that is counted in one round of the loop is limited to the same time, so
that the client is not blamed if the mock gets no processor time.
"""

STOPPING = ("stop", "watchdog", "fault", "release")

TELL = Tell(
    command="hil mock plc",
    who="mock PLC answers",
    requests="fault, clear, state, push, mount or speed",
    examples="""\
send fault emergency_stop for_s=1     begin a fault: see docs/how-to/drive-twincat.md
send clear                            end all faults
send state                            true pose, state of the PLC, faults
send speed 10                         run device time ten times as fast as wall time
""",
    places={
        "--address": (str, "address of the mock (default: 127.0.0.1)"),
        "--side": (str, "side channel of the mock, if it was started with --side"),
    },
    elsewhere="or check --address and --side",
    main_keys={"fault": "kind", "speed": "factor"},
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
    """Return the parser of `hil mock plc` and `python -m hil_mock_robot plc`."""
    parser = Parser(
        "plc",
        prog,
        "PLC that plays trajectories, by ADS on a loopback port, with a simulated arm.",
    )
    add = parser.add_argument
    where = "loopback address; the port is 48898, so a second mock needs a different address"
    add("--address", default="127.0.0.1", help=where)
    add("--speed", default="1", help="device seconds per second, 0.01 to 1000")
    add(
        "--effort",
        default="torque",
        choices=("torque", "current"),
        help="effort that the drives report",
    )
    add(
        "--serial",
        default="",
        help="serial number of the PLC (default: derived from model and seed)",
    )
    add("--contract", type=int, help="reported version of the contract (default: the true one)")
    add(
        "--without",
        action="append",
        default=[],
        metavar="NAME",
        help="variable that the PLC lacks; repeatable",
    )
    parser.add_arm("lab6", None, seed)
    side = (
        f"socket of the side channel for tests, `{NO_SIDE}` for none; by default from the address"
    )
    add("--side", default="", metavar="PATH", help=side)
    parser.add_records()
    TELL.add_to(parser)
    return parser


def _side_path(given: argparse.Namespace) -> str:
    return given.side or usual_path(f"plc-{given.address}")


def _send(given: argparse.Namespace) -> int:
    return show(TELL.ask(_side_path(given), TELL.request(given.request, given.more)))


def _run(given: argparse.Namespace) -> int:
    address, factor = loopback_of(given.address), factor_of(given.speed)
    if factor is None:
        raise SpecError(
            f"--speed {given.speed} is for the UR mock", hint="give a number from 0.01 to 1000"
        )
    where = f"{address}, AMS {address}.1.1:{AMS_PORT}"
    loop = loop_of(given, address, factor)
    return serve(loop, f"{given.model} behind a PLC on {where}, ×{factor:g}")


def loop_of(given: argparse.Namespace, address: str, factor: float) -> Loop:
    """Return the PLC on its port, with faults, journal and side channel.

    Raises:
        SpecError: The file of faults or the starting pose is invalid.
        RobotConnectionError: The journal cannot be written.
        PluginError: The port is in use.
    """
    witness = Witness(journal_of(given.journal, address))
    memory, arm = Memory(given.without), arm_of(given)
    fill_info(memory, arm, given)
    program = PlcProgram(memory, arm)
    handler = PlcHandler(memory, AMS_PORT)
    planned = PlcFault.read(given.faults) if given.faults else ()
    links = Links(address, handler)
    faults = Faults(Target(program, handler, links), PlcFault, CYCLE_S, planned)

    def count_motions(event: str, details: dict[str, Any]) -> None:
        if event == "start" and details["by"] == "start":
            faults.began("motion")

    program.listeners += [witness.happened, count_motions]
    return Loop(program, links, faults, witness, factor=factor, side=_side_path(given))


def arm_of(given: argparse.Namespace) -> PlcArm:
    """Return the arm according to the command line."""
    maker = published(given.model)
    q = pose_of(given.start_q_deg or upright_deg(maker), maker)
    mounted = mounted_of(given.mounted_kg)
    return PlcArm(truth_of(given), RATE_HZ, q, torque=given.effort == "torque", mounted=mounted)


def fill_info(memory: Memory, arm: PlcArm, given: argparse.Namespace) -> None:
    """Write `stInfo` and the version of the contract into the memory of the PLC."""
    info, maker = memory.view("stInfo")[0], arm.published
    info["fCycleS"], info["fWatchdogS"] = CYCLE_S, WATCHDOG_S
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


class Loop(loop.Loop):
    """Main loop that serves ADS, advances device time, and applies faults.

    Args:
        program: Program of the PLC.
        links: Connections of clients.
        faults: Fault schedule of the mock.
        witness: Writer of the journal.
        factor: Device seconds per second of wall time.
        side: Socket of the side channel, or `NO_SIDE`.
    """

    def __init__(
        self,
        program: PlcProgram,
        links: Links,
        faults: Faults[Target],
        witness: Witness,
        *,
        factor: float,
        side: str = NO_SIDE,
    ) -> None:
        super().__init__()
        self._program, self._links, self._faults, self._witness = program, links, faults, witness
        self._side = None if side == NO_SIDE else SideChannel(side, PlcRequests(self, faults))
        self.change(factor)

    def change(self, factor: float) -> None:
        """Change the speed to `factor` device seconds per second of wall time."""
        self._cycles_per_s = factor / CYCLE_S
        self._began = self._last = time.monotonic()
        self._passed = 0.0

    def turn(self) -> None:
        """Serve clients, and execute the cycles that are due."""
        self._links.serve(self._last + ROUND_S - time.monotonic())
        now = time.monotonic()
        late = now - self._began - self._passed / self._cycles_per_s
        if late > LATEST_S:
            self._began += late - ROUND_S
        due = int((now - self._began) * self._cycles_per_s - self._passed)
        if now - self._last < ROUND_S or due <= 0:
            return
        wall_s, self._last = min(now - self._last, LATEST_S), now
        self._passed += due
        self._pass(due, wall_s)

    def leave(self) -> None:
        """Close all connections and the journal."""
        self._links.cut()
        if self._side is not None:
            self._side.close()
        self._witness.close()

    def _pass(self, cycles: int, wall_s: float) -> None:
        self._faults.passed(cycles)
        if self._side is not None:
            self._side.serve()
        if not self._faults.mock.stopped:
            self._program.watch(wall_s)
            self._witness.passed(self._program.cycles(cycles))


class PlcRequests(Requests):
    """Requests to the mock PLC on its side channel.

    Args:
        loop: Main loop of the mock.
        faults: Fault schedule of the mock.
    """

    def __init__(self, loop: Loop, faults: Faults[Target]) -> None:
        arm = faults.mock.program.arm
        super().__init__(faults, arm.published.n_joints)
        self._loop, self._arm = loop, arm
        self.answers["speed"] = self._speed

    def push(self, torque: FloatArray) -> None:
        """See `Requests`."""
        self._arm.push(torque)

    def mount(self, payload: Payload | None) -> None:
        """See `Requests`."""
        self._arm.mount(payload)

    def truth(self) -> Answer:
        """See `Requests`."""
        program, arm = self.faults.mock.program, self._arm
        return {
            "device_time": program.device_time,
            "phase": program.phase.name,
            "q": listed(arm.position),
            "qd": listed(arm.speed),
            "q_target": listed(arm.setpoint[0]),
            "braked": arm.braked,
            "declared_kg": arm.declared.mass,
            "mounted_kg": arm.mounted.mass,
        }

    def _speed(self, request: Request) -> Answer:
        self._loop.change(factor_in(request))
        return {}


class Witness(journal.Witness):
    """Writer of the journal of the PLC's events."""

    def __init__(self, journal: Journal) -> None:
        super().__init__(journal)
        self._cycles, self._speed = 0, 0.0

    def moment(self) -> Moment:
        """Return the present times and the speed of the arm; see `server.journal.Witness`."""
        return Moment(time.monotonic(), self._cycles * CYCLE_S, self._speed)

    def happened(self, event: str, details: dict[str, Any]) -> None:
        """Write an event of the PLC program to the journal."""
        if event == "start":
            self._rest.moved()
        self.note(event, **details)
        if event in STOPPING:
            self._rest.stopped(event, self.moment())

    def passed(self, speeds: FloatArray) -> None:
        """Check after a block of cycles whether a stopped arm has come to rest.

        Args:
            speeds: True joint speeds of the cycles, (N, n) [rad/s].
        """
        first, self._cycles = self._cycles, self._cycles + len(speeds)
        self._speed = float(np.abs(speeds[-1]).max()) if len(speeds) else 0.0
        if self._rest.waiting:
            times: FloatArray = np.arange(first, self._cycles, dtype=float) * CYCLE_S
            self._rest.see(times, speeds, time.monotonic(), 0.0)
