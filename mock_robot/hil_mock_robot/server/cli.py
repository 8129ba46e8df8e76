"""The command line of a mock server: options that several mocks take, and running until a signal.

A mock builds its parser of its protocol's own options and of `add_arm` and `add_records`, and runs
by `serve`: it serves until SIGINT, SIGTERM or SIGHUP, or asks a mock that runs (`tell`).
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from hil.core import HilError
from hil_mock_robot.plant.truth import Truth, draw_truth


class Parser(argparse.ArgumentParser):
    """The command line of `hil mock NAME` and `python -m hil_mock_robot NAME`.

    Args:
        name: Of the mock.
        prog: Command by which it was started; this process's own when empty.
        description: Of the mock, for its help.

    Attributes:
        own: Whether it runs as a process of its own, not by way of `hil mock`.
    """

    def __init__(self, name: str, prog: str, description: str) -> None:
        self.own = not prog
        super().__init__(
            prog=prog or f"python -m hil_mock_robot {name}",
            formatter_class=WithDefaults,
            description=f"{description} It is there when it says `ready`, until Ctrl-C.",
        )

    def add_arm(
        self, model: str, models: Sequence[str] | None, seed: int, *, start: str = "a safe pose"
    ) -> None:
        """Add the options of the arm: model, pose, load.

        Args:
            model: By default.
            models: Those it may be; None for any built-in arm and any description of one.
            seed: By default.
            start: Where the arm stands when nothing is said.
        """
        add = self.add_argument
        add("--model", default=model, choices=models, help="of the arm")
        add("--seed", type=int, default=seed, help="which individual")
        add("--profile", default="full", choices=("full", "ideal"), help="of the physics")
        stands = f"where the arm stands at first, joint by joint; {start} without"
        add("--start-q-deg", type=float, nargs="+", metavar="Q", help=stands)
        hangs = "what really hangs at the flange, whatever is declared: mass and centre [m]"
        add("--mounted-kg", type=float, nargs=4, metavar=("KG", "X", "Y", "Z"), help=hangs)

    def add_records(self) -> None:
        """Add the options of faults and journal."""
        add = self.add_argument
        add("--faults", type=Path, help="YAML file: what goes wrong, and when")
        add("--journal", type=Path, help="file for what it was told and what it did")
        truth = "write every true parameter to this file, for scoring"
        add("--truth", type=Path, help=truth if self.own else f"{truth}, and start nothing")


class WithDefaults(argparse.ArgumentDefaultsHelpFormatter):
    """Defaults behind the options that have one worth telling."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        shown = isinstance(default, str | int | float) and default is not False and default != ""
        return super()._get_help_string(action) if shown else action.help


def truth_of(given: argparse.Namespace) -> Truth:
    """The individual that `add_arm` names; written to the file of `--truth`."""
    truth = draw_truth(given.model, given.seed, given.profile)
    if given.truth:
        truth.to_json(given.truth)
    return truth


class Loop(Protocol):
    """The loop that serves a mock."""

    def run(self) -> None:
        """Serve until `end`."""

    def end(self) -> None:
        """Let `run` return; called by a signal handler."""


def serve(loop: Loop, ready: str) -> int:
    """Print that the mock is ready, and run until SIGINT, SIGTERM or SIGHUP."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: loop.end())
    print(f"ready: {ready}", flush=True)  # noqa: T201
    loop.run()
    return 0


def show(answer: object) -> int:
    """Print the answer to `tell` as JSON."""
    print(json.dumps(answer), flush=True)  # noqa: T201
    return 0


def exit_code_of(run: Callable[[], int]) -> int:
    """Run a mock and return its exit code; errors are printed to standard error."""
    try:
        return run()
    except HilError as error:
        hint = f"\n  next: {error.hint}" if error.hint else ""
        print(f"{type(error).__name__}: {error.message}{hint}", file=sys.stderr)  # noqa: T201
        return int(error.exit_code)
