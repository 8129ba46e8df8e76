"""`hil mock can tell …`: one request to the side channel of a mock that runs, from a shell."""

from __future__ import annotations

import argparse
import json
import socket
from typing import Any

from hil.core import CommandRefused, RobotConnectionError

ANSWER_S = 60.0
MAIN_KEYS = {"fault": "kind"}
"""Request → what a bare word after it means."""

EXAMPLES = """\
examples:
tell fault following_error axis=3    something goes wrong: see docs/reference/mock-can-faults.md
tell fault heartbeat_loss for_s=2
tell clear                           what lasts is over
tell state                           where the arm is, states of the drives, faults
tell mount mass_kg=3 com_m=[0,0,0.05]
"""


def add_tell(parser: argparse.ArgumentParser) -> None:
    """Let a command line be `tell` and a request, in place of starting a mock."""
    commands = parser.add_subparsers(dest="command", metavar="[tell REQUEST …]")
    tell = commands.add_parser(
        "tell",
        help="in place of starting one: ask a mock that runs for something, such as a fault; "
        "`tell --help` tells more",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="One request to a mock that runs; its answer is printed as JSON.",
    )
    left_out = argparse.SUPPRESS  # or it would overrule what stands before `tell`
    tell.add_argument("--channel", default=left_out, help="of the mock (default: can0)")
    tell.add_argument("--interface", default=left_out, help="(default: hil_unix)")
    tell.add_argument("--side", default=left_out, help="of the mock, where it has one of its own")
    tell.add_argument("request", help="fault, clear, state, push or mount")
    tell.add_argument("more", nargs="*", metavar="KEY=VALUE", help="what the request holds")


def tell(path: str, request: dict[str, Any]) -> dict[str, Any]:
    """Ask a mock for something; its answer.

    Args:
        path: Of its side channel.
        request: See docs/reference/mock-can.md.

    Raises:
        RobotConnectionError: No mock listens there.
        CommandRefused: It does not do that.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
            line.settimeout(ANSWER_S)
            line.connect(path)
            line.sendall(json.dumps(request).encode() + b"\n")
            with line.makefile("r", encoding="utf-8") as answers:
                answer = dict(json.loads(answers.readline()))
    except (OSError, ValueError) as error:
        raise RobotConnectionError(
            f"no mock drives answer at {path}: {error}",
            hint="start them: hil mock can; are they on another --channel or --side?",
        ) from error
    if "error" in answer:
        raise CommandRefused(answer["error"], hint=answer.get("hint", ""))
    return answer
