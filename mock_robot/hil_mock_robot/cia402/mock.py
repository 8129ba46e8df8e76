"""Mock of an arm that has CiA 402 drives on a CAN bus.

`Mock` connects all parts of the mock; its `Loop` handles frames between the steps of the drives.
`main` runs the mock as a process (`hil mock can`); `mock_on_virtual_bus` runs it in a thread, for
tests.
"""

from __future__ import annotations

import argparse
import gc
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hil.arms import ArmDescription, Payload, arm_names, load_arm
from hil.core import FloatArray, RecordingError, SpecError
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.body import STEP_S, Body
from hil_mock_robot.cia402.bus import HOSTED, BusEnd, end_of, side_path
from hil_mock_robot.cia402.dictionary import eds_of, object_dictionary, registers_of
from hil_mock_robot.cia402.faults import CanFault, Target, faults_of_station
from hil_mock_robot.cia402.journal import Witness
from hil_mock_robot.cia402.station import PATIENCE_S, DeviceClock, MotionWatch, Station
from hil_mock_robot.plant.truth import Profile, Truth, draw_truth
from hil_mock_robot.server import loop
from hil_mock_robot.server.cli import Parser, exit_code_of, serve, show, truth_of
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.journal import journal_of
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.server.options import mounted_of, pose_of
from hil_mock_robot.server.side_channel import (
    NO_SIDE,
    Answer,
    Requests,
    SideChannel,
    Tell,
    listed,
)

MODEL, CHANNEL, INTERFACE, MASTER_ID = "lab6", "can0", "hil_unix", 127
MOST_NODE = 127

TELL = Tell(
    command="hil mock can",
    who="mock drives answer",
    requests="fault, clear, state, push or mount",
    examples="""\
send fault following_error axis=3    inject a fault, see docs/reference/mock-can-faults.md
send fault heartbeat_loss for_s=2
send clear                           end all active faults
send state                           print arm position, drive states, active faults
send mount mass_kg=3 com_m=[0,0,0.05]
""",
    places={
        "--channel": (str, "of the mock (default: can0)"),
        "--interface": (str, "(default: hil_unix)"),
        "--side": (str, "of the mock, if the mock was started with it"),
    },
    elsewhere="check --channel and --side",
)


def main(arguments: Sequence[str] | None = None, *, prog: str = "", seed: int = 1) -> int:
    """Run the mock until SIGINT, SIGTERM or SIGHUP; return the exit code.

    Args:
        arguments: Command-line arguments; None for the arguments of this process.
        prog: Command that started the mock, used in the help text.
        seed: Default of the seed from which the parameters of the arm are drawn.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    do = _send if given.command else _write_eds if given.eds else _run
    return exit_code_of(lambda: do(given))


def parser_of(prog: str = "", seed: int = 1) -> Parser:
    """Return the command-line parser of `hil mock can` and `python -m hil_mock_robot can`."""
    parser = Parser("can", prog, "CiA 402 drives on a CAN bus, with a simulated arm between them.")
    add = parser.add_argument
    channel = "of the bus: a name, or the path of its socket; a second mock needs a different one"
    add("--channel", default=CHANNEL, help=channel)
    interface = f"{INTERFACE}: the mock hosts the bus; otherwise an interface of python-can"
    add("--interface", default=INTERFACE, help=interface)
    rate = f"of the bus [bit/s]; on {INTERFACE}, the wire is modelled only with this option"
    add("--bitrate", type=float, metavar="BIT_S", help=rate)
    wire = "seconds of the modelled wire per second of the clock: the `pace` of the master"
    wire += " (default: 1)"
    add("--wire-speed", type=float, metavar="FACTOR", help=wire)
    add("--nodes", type=int, nargs="+", default=(), metavar="ID", help="node ids (default: 1, 2 …)")
    announces = "node id of the master, for the events that it announces"
    add("--master-id", type=int, default=MASTER_ID, metavar="ID", help=announces)
    patience = "wall time without SYNC after which the drives run on their own timer"
    add("--sync-patience-s", type=float, default=PATIENCE_S, metavar="S", help=patience)
    parser.add_arm(MODEL, arm_names(), seed, start="all zeros")
    side = f"socket of the side channel for tests, or `{NO_SIDE}` (default: next to the bus)"
    add("--side", default="", metavar="PATH", help=side)
    parser.add_records()
    add("--eds", type=Path, help="write the drives' electronic data sheet (EDS), then exit")
    TELL.add_to(parser)
    return parser


def _send(given: argparse.Namespace) -> int:
    path = given.side or side_path(given.interface, given.channel)
    return show(TELL.ask(path, TELL.request(given.request, given.more)))


def _write_eds(given: argparse.Namespace) -> int:
    dictionary = object_dictionary(1, registers_of(load_arm(given.model), 0))
    try:
        given.eds.write_bytes(eds_of(dictionary))
    except OSError as error:
        raise RecordingError(
            f"cannot write {given.eds}: {error.strerror}",
            hint="for --eds, choose a folder with write permission",
        ) from error
    print(given.eds)  # noqa: T201
    return 0


def _run(given: argparse.Namespace) -> int:
    # Invalid requests of a client are answered by an abort code and need no log message.
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    end = end_of(given.interface, given.channel, given.bitrate, given.wire_speed)
    try:
        mock = _mock_of(given, end)
    except BaseException:
        end.close()
        raise
    mock.loop.mishaps.contained = True
    gc.collect()
    gc.freeze()  # permanent objects are excluded from garbage collection
    return serve(mock.loop, f"{given.model} on {end.where}{_wire(given)}")


def _mock_of(given: argparse.Namespace, end: BusEnd) -> Mock:
    side = given.side or side_path(given.interface, given.channel)
    return Mock(
        truth_of(given),
        end,
        nodes=given.nodes,
        start_q_deg=given.start_q_deg or (),
        mounted=mounted_of(given.mounted_kg),
        master_id=given.master_id,
        patience_s=given.sync_patience_s,
        faults=CanFault.read(given.faults) if given.faults else (),
        journal=given.journal,
        side=None if side == NO_SIDE else side,
    )


def _wire(given: argparse.Namespace) -> str:
    if given.bitrate is None:
        return ""
    modelled = ", modelled" if given.interface == HOSTED else ""
    faster = f" at {given.wire_speed:g} times real time" if given.wire_speed else ""
    return f", {given.bitrate / 1000:g} kbit/s{modelled}{faster}"


class Mock:
    """Mock drives on a bus, with faults, journal and side channel.

    Args:
        truth: True parameters of the arm.
        end: Connection of the drives to the bus.
        nodes: Node id of each axis; empty for the ids 1, 2, …
        start_q_deg: Joint positions of the arm at the start [deg]; empty for zeros.
        mounted: True payload at the flange; None for the payload that the master declares.
        master_id: Node id of the master's marker.
        patience_s: Wall time without SYNC after which the drives use their own timer [s].
        faults: Planned faults.
        journal: Path of the file for the journal of events.
        side: Socket of the side channel.

    Attributes:
        station: All drives of the arm.
        motions: Detector of the arm's motions.
        faults: Fault injection.
        requests: Requests of the side channel.
        loop: Main loop.

    Raises:
        SpecError: An option or a fault is invalid.
        RobotConnectionError: The journal cannot be written.
        PluginError: The socket of the side channel cannot be opened.
    """

    def __init__(
        self,
        truth: Truth,
        end: BusEnd,
        *,
        nodes: Sequence[int] = (),
        start_q_deg: Sequence[float] = (),
        mounted: Payload | None = None,
        master_id: int = MASTER_ID,
        patience_s: float = PATIENCE_S,
        faults: Sequence[CanFault] = (),
        journal: Path | str | None = None,
        side: Path | str | None = None,
    ) -> None:
        arm = load_arm(truth.arm)
        body = Body(truth, pose_of(start_q_deg or (0.0,) * arm.n_joints, arm), mounted=mounted)
        clock = DeviceClock(time.monotonic(), patience_s)
        ids = nodes_of(nodes, body.arm, master_id)
        self.station = Station(body, ids, end.send, clock, master_id, mounted, end.flush)
        self.motions = MotionWatch(self.station)
        witness = self._witness(end, journal)
        self.faults = faults_of_station(self.station, end, faults)
        self.motions.listeners.append(self._moved)
        if witness is not None:
            self.faults.listeners.append(witness.struck)
        # The motion must be counted before the faults that wait for it are checked, and before
        # the journal records its end.
        self.station.passed += [self.motions.passed, self.faults.passed]
        if witness is not None:
            self.station.passed.append(witness.passed)
        self.requests = CanRequests(self.station, self.faults)
        channel = None if side is None else SideChannel(side, self.requests)
        self.loop = Loop(end, self.station, channel, witness)

    def _moved(self, begins: bool) -> None:
        if begins:
            self.faults.began("motion")

    def _witness(self, end: BusEnd, path: Path | str | None) -> Witness | None:
        if path is None:
            return None
        return Witness(self.station, self.motions, journal_of(path, end.where))


def nodes_of(given: Sequence[int], arm: ArmDescription, master_id: int) -> tuple[int, ...]:
    """Return the node id of each axis.

    Raises:
        SpecError: The node ids are invalid.
    """
    nodes = tuple(given) or tuple(range(1, arm.n_joints + 1))
    if len(nodes) != arm.n_joints:
        raise SpecError(
            f"--nodes names {len(nodes)} drives, the arm {arm.name} has {arm.n_joints} joints",
            hint="use one node id per joint, beginning at the base",
        )
    if len({*nodes, master_id}) != len(nodes) + 1 or not all(
        1 <= node <= MOST_NODE for node in (*nodes, master_id)
    ):
        raise SpecError(
            f"--nodes {list(nodes)} and --master-id {master_id} cannot be on one bus",
            hint=f"use different numbers from 1 to {MOST_NODE}",
        )
    return nodes


class CanRequests(Requests):
    """Handler of the requests that arrive on the side channel of the mock.

    Args:
        station: All drives of the arm.
        faults: Fault injection of the mock.
    """

    def __init__(self, station: Station, faults: Faults[Target]) -> None:
        super().__init__(faults, len(station.axes))
        self._station = station

    def push(self, torque: FloatArray) -> None:
        """See `Requests`."""
        self._station.body.push(torque)

    def mount(self, payload: Payload | None) -> None:
        """See `Requests`."""
        self._station.mount(payload)

    def truth(self) -> Answer:
        """See `Requests`."""
        station = self._station
        seen, axes = station.body.seen, station.axes
        return {
            "device_time": station.clock.device_s,
            "syncs": station.clock.syncs,
            "synced": station.clock.synced,
            "segment": station.marker.segment,
            "moving": station.marker.moving,
            "q": listed(np.array([each.true_q for each in seen])),
            "qd": listed(np.array([each.true_qd for each in seen])),
            "celsius": listed(np.array([each.celsius for each in seen])),
            "speed_rad_s": float(station.body.fastest),
            "states": [axis.drive.state.name for axis in axes],
            "nmt": [axis.node.nmt.state for axis in axes],
            "modes": [axis.registers[keys.MODE_DISPLAY] for axis in axes],
            "errors": [axis.registers[keys.ERROR_CODE] for axis in axes],
            "declared_kg": station.declared.mass,
            "mounted_kg": station.mounted.mass,
        }


OWN_STEPS = 10
"""Number of steps that the drives' own timer advances in one block."""

SIDE_S = 0.01
"""Wall time between two checks of the side channel while the bus is busy [s]."""

SLEPT_S = 0.05
"""Delay of a turn of the loop from which the computer, and thus the master, counts as busy [s]."""


class Loop(loop.Loop):
    """Main loop of the mock in one thread, which handles frames between the steps of the drives.

    Args:
        end: Connection of the drives to the bus.
        station: All drives of the arm.
        side: Side channel; None for no side channel.
        witness: Writer of the journal; None for no journal.

    Attributes:
        mishaps: Internal errors of the mock.
    """

    def __init__(
        self,
        end: BusEnd,
        station: Station,
        side: SideChannel | None = None,
        witness: Witness | None = None,
    ) -> None:
        super().__init__()
        self._end, self._station = end, station
        self._side, self._witness = side, witness
        self.mishaps = Mishaps()
        if witness is not None:
            self.mishaps.listeners.append(witness.stumbled)
        self._calls: deque[Callable[[], None]] = deque()
        self._side_due_s = 0.0
        self._turned_s = time.monotonic()
        self._beside_bus: list[socket.socket] = [self.woken]
        end.heard = self._heard

    def run(self) -> None:
        """Switch the drives on, and serve the bus until `end` is called."""
        self._station.boot()
        super().run()

    def ask(self, action: Callable[[], None]) -> None:
        """Queue an action of another thread, which the loop executes between two turns."""
        self._calls.append(action)
        self.wake()

    def leave(self) -> None:
        """Close the connection to the bus, the side channel and the journal."""
        if self._side is not None:
            self._side.close()
        self._end.close()
        if self._witness is not None:
            self._witness.close(syncs=self._station.clock.syncs)

    def turn(self) -> None:
        """Handle received frames; without SYNC, advance the drives by their own timer."""
        clock = self._station.clock
        wait_s = min(clock.wait_s(time.monotonic(), OWN_STEPS), SIDE_S)
        asked = self._end.serve(wait_s, self._beside_bus)
        now_s = time.monotonic()
        if now_s - self._turned_s > SLEPT_S:
            clock.slept(now_s - self._turned_s)
        self._turned_s = now_s
        if clock.wait_s(now_s, OWN_STEPS) <= STEP_S / 10:
            self._end.serve(0.0)  # handle a SYNC received until then
            self._lapse(now_s)
        if asked or self._calls or now_s >= self._side_due_s:
            self._side_due_s = now_s + SIDE_S
            self._beside()

    def _heard(self, can_id: int, data: bytes, now_s: float) -> None:
        try:
            self._station.heard(can_id, data, now_s)
        except Exception as error:
            self.mishaps.met(error, f"frame {can_id:03X}#{data.hex()}")

    def _lapse(self, now_s: float) -> None:
        try:
            self._station.lapsed(now_s)
        except Exception as error:
            self.mishaps.met(error, "the drives' own timer")

    def _beside(self) -> None:
        self.woke()
        while self._calls:
            self._calls.popleft()()
        if self._side is not None:
            self._side.serve()
            self._beside_bus = [self.woken, *self._side.sockets]


T = TypeVar("T")
ANSWER_S = 30.0


class HostedMock:
    """Mock that runs in a separate thread.

    Args:
        mock: Mock to run; other threads must access this mock by `ask` only.
    """

    def __init__(self, mock: Mock) -> None:
        self._mock = mock
        self._mishap: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hil-mock-can", daemon=True)
        self._thread.start()

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """Execute a request, as on the side channel, and return the answer.

        Raises:
            HilError: The request is invalid or cannot be executed.
        """
        return self.ask(lambda mock: mock.requests.answer({"do": do, **more}) or {})

    def ask(self, question: Callable[[Mock], T]) -> T:
        """Call `question` in the mock's thread between two frames; return or raise the result."""
        done = threading.Event()
        found: list[T] = []
        raised: list[Exception] = []

        def answer() -> None:
            try:
                found.append(question(self._mock))
            except Exception as error:
                raised.append(error)
            done.set()

        self._mock.loop.ask(answer)
        while not done.wait(0.1):
            if not self._thread.is_alive():
                raise RuntimeError("the mock has ended") from self._mishap
        if raised:
            raise raised[0]
        return found[0]

    def close(self) -> None:
        """End the mock; raise the error that ended the mock earlier, if there was an error."""
        self._mock.loop.end()
        self._thread.join(ANSWER_S)
        if self._mishap is not None:
            raise self._mishap

    def _run(self) -> None:
        try:
            self._mock.loop.run()
        except BaseException as error:
            self._mishap = error


@contextmanager
def mock_on_virtual_bus(
    channel: str,
    *,
    interface: str = "virtual",
    model: str = "lab6",
    seed: int = 1,
    profile: Profile = "full",
    bitrate: float | None = None,
    **options: Any,
) -> Iterator[HostedMock]:
    """Run mock drives in a thread during a `with` block, at whose beginning the bus exists.

    Args:
        channel: Channel of the bus.
        interface: Interface of python-can; on `hil_unix` the mock hosts the bus.
        model: Name of a built-in arm.
        seed: Seed from which the parameters of the arm are drawn.
        profile: Name of the profile of the simulated physics.
        bitrate: Bit rate of the bus [bit/s]; on `hil_unix`, bit rate of the modelled wire.
        **options: Options of `Mock`.
    """
    end = end_of(interface, channel, bitrate)
    try:
        mock = Mock(draw_truth(model, seed, profile), end, **options)
    except BaseException:
        end.close()
        raise
    hosted = HostedMock(mock)
    try:
        yield hosted
    finally:
        hosted.close()
