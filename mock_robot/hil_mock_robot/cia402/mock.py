"""The mock drives: an arm on CiA 402 drives on a CAN bus.

`Mock` puts the parts together, its `Loop` serves frames between the drives' steps. `main` runs it
as a process (`hil mock can`), `mock_on_virtual_bus` in a thread of the present one, for tests.
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
tell fault following_error axis=3    something goes wrong: see docs/reference/mock-can-faults.md
tell fault heartbeat_loss for_s=2
tell clear                           what lasts is over
tell state                           where the arm is, states of the drives, faults
tell mount mass_kg=3 com_m=[0,0,0.05]
""",
    places={
        "--channel": (str, "of the mock (default: can0)"),
        "--interface": (str, "(default: hil_unix)"),
        "--side": (str, "of the mock, where it has one of its own"),
    },
    elsewhere="are they on another --channel or --side?",
)


def main(arguments: Sequence[str] | None = None, *, prog: str = "", seed: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    Args:
        arguments: Of the command line, by default this process's.
        prog: Command by which it was started, for its help.
        seed: Default individual.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    do = _tell if given.command == "tell" else _write_eds if given.eds else _run
    return exit_code_of(lambda: do(given))


def parser_of(prog: str = "", seed: int = 1) -> Parser:
    """The command line of `hil mock can` and `python -m hil_mock_robot can`."""
    parser = Parser("can", prog, "CiA 402 drives on a CAN bus, with a simulated arm between them.")
    add = parser.add_argument
    channel = "of the bus: a name, or the path of its socket; a second mock takes another one"
    add("--channel", default=CHANNEL, help=channel)
    interface = f"{INTERFACE}: the mock hosts the bus; else an interface of python-can"
    add("--interface", default=INTERFACE, help=interface)
    rate = f"of the bus [bit/s]; on {INTERFACE} the wire is modelled with it, without it is not"
    add("--bitrate", type=float, metavar="BIT_S", help=rate)
    wire = "seconds of the modelled wire in one of the clock: the `pace` of the master; 1 without"
    add("--wire-speed", type=float, metavar="FACTOR", help=wire)
    add("--nodes", type=int, nargs="+", default=(), metavar="ID", help="node ids; 1, 2 … without")
    announces = "node id under which the master announces what it does"
    add("--master-id", type=int, default=MASTER_ID, metavar="ID", help=announces)
    patience = "wall time without SYNC after which the drives go by their own timer"
    add("--sync-patience-s", type=float, default=PATIENCE_S, metavar="S", help=patience)
    parser.add_arm(MODEL, arm_names(), seed, start="all zeros")
    side = f"socket of the side channel for tests, `{NO_SIDE}` for none; beside the bus without"
    add("--side", default="", metavar="PATH", help=side)
    parser.add_records()
    add("--eds", type=Path, help="write the drives' electronic data sheet (EDS), and stop")
    TELL.add_to(parser)
    return parser


def _tell(given: argparse.Namespace) -> int:
    path = given.side or side_path(given.interface, given.channel)
    return show(TELL.ask(path, TELL.request(given.request, given.more)))


def _write_eds(given: argparse.Namespace) -> int:
    dictionary = object_dictionary(1, registers_of(load_arm(given.model), 0))
    try:
        given.eds.write_bytes(eds_of(dictionary))
    except OSError as error:
        raise RecordingError(
            f"cannot write {given.eds}: {error.strerror}",
            hint="give --eds a path in a folder that can be written",
        ) from error
    print(given.eds)  # noqa: T201
    return 0


def _run(given: argparse.Namespace) -> int:
    # What a client asks out of place is answered by an abort code, and no news for a terminal.
    logging.getLogger("canopen").addHandler(logging.NullHandler())
    end = end_of(given.interface, given.channel, given.bitrate, given.wire_speed)
    try:
        mock = _mock_of(given, end)
    except BaseException:
        end.close()
        raise
    mock.loop.mishaps.contained = True
    gc.collect()
    gc.freeze()  # what is here now stays: it is not looked through again between two SYNCs
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
    """Drives on a bus, with faults, journal and side channel.

    Args:
        truth: What the arm is really like.
        end: Of the bus.
        nodes: Node id of each axis; 1, 2 … when empty.
        start_q_deg: Where the arm stands at first; zeros when empty.
        mounted: Load that really hangs at the flange; the declared one when None.
        master_id: Node id under which the master announces what it does.
        patience_s: Wall time without SYNC after which the drives go by their own timer.
        faults: Planned faults.
        journal: File for what happens.
        side: Socket of the side channel.

    Attributes:
        station, motions, faults, requests, loop: Its parts.

    Raises:
        SpecError: An option or a fault cannot be.
        RobotConnectionError: The journal cannot be written.
        PluginError: The side channel cannot listen.
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
        # The motion is counted before faults that wait for it are looked at, and before the
        # journal says how it ended.
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


class CanRequests(Requests):
    """Requests to the drives by the side channel.

    Args:
        station: The drives.
        faults: Of the mock.
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
"""Steps that the drives' own timer makes in one block."""

SIDE_S = 0.01
"""Wall time between two looks at the side channel while the bus is busy."""

SLEPT_S = 0.05
"""A turn that is later by so much: the computer was busy, for the master as well."""


class Loop(loop.Loop):
    """Serves frames between the drives' steps, in one thread.

    Args:
        end: Of the bus.
        station: The drives.
        side: The side channel, if there is one.
        witness: Writes the journal, if there is one.

    Attributes:
        mishaps: Mistakes of the mock itself.
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
        self._asked: deque[Callable[[], None]] = deque()
        self._side_due_s = 0.0
        self._turned_s = time.monotonic()
        self._beside_bus: list[socket.socket] = [self.woken]
        end.heard = self._heard

    def run(self) -> None:
        """Power on, and serve until `end`."""
        self._station.boot()
        super().run()

    def ask(self, action: Callable[[], None]) -> None:
        """Let the loop call `action` between two turns; for other threads."""
        self._asked.append(action)
        self.wake()

    def leave(self) -> None:
        """Leave the bus."""
        if self._side is not None:
            self._side.close()
        self._end.close()
        if self._witness is not None:
            self._witness.close(syncs=self._station.clock.syncs)

    def turn(self) -> None:
        """Handle frames that have come; without SYNC, let the drives' own timer go on."""
        clock = self._station.clock
        wait_s = min(clock.wait_s(time.monotonic(), OWN_STEPS), SIDE_S)
        asked = self._end.serve(wait_s, self._beside_bus)
        now_s = time.monotonic()
        if now_s - self._turned_s > SLEPT_S:
            clock.slept(now_s - self._turned_s)
        self._turned_s = now_s
        if clock.wait_s(now_s, OWN_STEPS) <= STEP_S / 10:
            self._end.serve(0.0)  # a SYNC that had come by then counts
            self._lapse(now_s)
        if asked or self._asked or now_s >= self._side_due_s:
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
        while self._asked:
            self._asked.popleft()()
        if self._side is not None:
            self._side.serve()
            self._beside_bus = [self.woken, *self._side.sockets]


T = TypeVar("T")
ANSWER_S = 30.0


class HostedMock:
    """A mock that a thread runs.

    Args:
        mock: The mock; others may touch it by `ask` only.
    """

    def __init__(self, mock: Mock) -> None:
        self._mock = mock
        self._mishap: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hil-mock-can", daemon=True)
        self._thread.start()

    def tell(self, do: str, **more: Any) -> dict[str, Any]:
        """A request of the side channel; its answer.

        Raises:
            HilError: It cannot be done.
        """
        return self.ask(lambda mock: mock.requests.answer({"do": do, **more}) or {})

    def ask(self, question: Callable[[Mock], T]) -> T:
        """Return the answer of the mock's own thread, between two frames; raise its errors here."""
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
        """End the mock; raise the error that ended it, if one did."""
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
    """Run mock drives in a thread while the block runs; the bus is there when it begins.

    Args:
        channel: Of the bus.
        interface: Of python-can; on `hil_unix` the mock hosts the bus.
        model: A built-in arm.
        seed: Which individual.
        profile: Of the physics.
        bitrate: Of the wire, where it is modelled.
        **options: As of `Mock`.
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
