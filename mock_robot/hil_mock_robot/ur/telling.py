"""`hil mock ur tell …`: one request to the side channel of a mock that runs, from a shell."""

from __future__ import annotations

import argparse
import json
import socket
from collections.abc import Sequence
from typing import Any

from hil.core import CommandRefused, RobotConnectionError
from hil_mock_robot.server import side_channel

ANSWER_S = 60.0
"""How long an answer may take: a long step of a mock in lock-step takes a while [s]."""

MAIN_KEYS = {"fault": "kind", "pendant": "press", "speed": "factor", "step": "ticks"}
"""Request → what a bare word after it means."""

EXAMPLES = """\
examples:
tell fault protective_stop        something goes wrong: see docs/reference/mock-ur-faults.md
tell fault silence for_s=2
tell clear                        what lasts is over
tell state                        where the arm is, modes, program, faults
tell pendant unlock               releases a protective stop, 5 s of device time after it
tell pendant release_emergency_stop
tell pendant brake_release        switches the arm on first, where it is off
"""


def add_tell(parser: argparse.ArgumentParser) -> None:
    """Let a command line be `tell` and a request, in place of starting a mock."""
    commands = parser.add_subparsers(dest="command", metavar="[tell REQUEST …]")
    tell = commands.add_parser(
        "tell",
        help="in place of starting one: ask a mock that runs for something, such as a fault, or "
        "its release; `tell --help` tells more",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="One request to a mock that runs; its answer is printed as JSON.",
    )
    left_out = argparse.SUPPRESS  # or it would overrule what stands before `tell`
    tell.add_argument("--address", default=left_out, help="of the mock (default: 127.0.0.1)")
    tell.add_argument("--side-port", type=int, default=left_out, help="(default: 30100)")
    requests = "fault, clear, state, pendant, push, mount, speed or step"
    tell.add_argument("request", help=requests)
    tell.add_argument("more", nargs="*", metavar="KEY=VALUE", help="what the request holds")


def request_of(do: str, more: Sequence[str]) -> dict[str, Any]:
    """The request that words of a shell stand for; values are JSON where they can be.

    Raises:
        SpecError: A word has no key.
    """
    return side_channel.request_of(do, more, MAIN_KEYS)


def tell(address: str, port: int, request: dict[str, Any]) -> dict[str, Any]:
    """Ask a mock for something; its answer.

    Raises:
        RobotConnectionError: No mock listens there.
        CommandRefused: It does not do that.
    """
    try:
        with socket.create_connection((address, port), ANSWER_S) as line:
            line.sendall(json.dumps(request).encode() + b"\n")
            with line.makefile("r", encoding="utf-8") as answers:
                answer = dict(json.loads(answers.readline()))
    except (OSError, ValueError) as error:
        raise RobotConnectionError(
            f"no mock UR controller answers at {address}:{port}: {error}",
            hint="start one: hil mock ur; is it another --address or --side-port?",
        ) from error
    if "error" in answer:
        raise CommandRefused(answer["error"], hint=answer.get("hint", ""))
    return answer
