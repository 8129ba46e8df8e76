"""`python -m hil_mock_robot can`: the mock drives as a process."""

from __future__ import annotations

import argparse
import gc
import json
import logging
import signal
from collections.abc import Sequence

from hil.arms import load_arm
from hil.core import RecordingError
from hil_mock_robot.cia402.assembly import Mock
from hil_mock_robot.cia402.bus import HOSTED, BusEnd, end_of, side_path
from hil_mock_robot.cia402.dictionary import eds_of, object_dictionary, registers_of
from hil_mock_robot.cia402.faults import CanFault
from hil_mock_robot.cia402.options import NO_SIDE, OWN_COMMAND, mounted_in, parser_of
from hil_mock_robot.cia402.telling import MAIN_KEYS, tell
from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.server.options import exit_code_of
from hil_mock_robot.server.side_channel import request_of


def main(arguments: Sequence[str] | None = None, *, prog: str = OWN_COMMAND, seed: int = 1) -> int:
    """Run until SIGINT, SIGTERM or SIGHUP; returns the exit code.

    Args:
        arguments: Of the command line, by default this process's.
        prog: What it was started as, for its help.
        seed: Which individual when nobody says.
    """
    given = parser_of(prog, seed).parse_args(arguments)
    do = _tell if given.command == "tell" else _write_eds if given.eds else _run
    return exit_code_of(lambda: do(given))


def _tell(given: argparse.Namespace) -> int:
    path = given.side or side_path(given.interface, given.channel)
    answer = tell(path, request_of(given.request, given.more, MAIN_KEYS))
    print(json.dumps(answer), flush=True)  # noqa: T201
    return 0


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
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: mock.loop.end())
    gc.collect()
    gc.freeze()  # what is here now stays: it is not looked through again between two SYNCs
    print(f"ready: {given.model} on {end.where}{_wire(given)}", flush=True)  # noqa: T201
    mock.loop.run()
    return 0


def _mock_of(given: argparse.Namespace, end: BusEnd) -> Mock:
    truth = draw_truth(given.model, given.seed, given.profile)
    if given.truth:
        truth.to_json(given.truth)
    side = given.side or side_path(given.interface, given.channel)
    return Mock(
        truth,
        end,
        nodes=given.nodes,
        start_q_deg=given.start_q_deg,
        mounted=mounted_in(given.mounted_kg),
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
