"""Command line of a mock server: common options, and running until a signal.

The parser of a mock has the options of its protocol, and those of `add_arm` and `add_records`. The
mock then either serves until SIGINT, SIGTERM or SIGHUP (`serve`), or sends a request to a running
mock (`send`).
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
    """Command-line parser of `hil mock NAME` and `python -m hil_mock_robot NAME`.

    Args:
        name: Name of the mock.
        prog: Command that started the mock; empty for `python -m hil_mock_robot`.
        description: Description of the mock, for its help.

    Attributes:
        own: Whether the mock was started without `hil mock`.
    """

    def __init__(self, name: str, prog: str, description: str) -> None:
        self.own = not prog
        super().__init__(
            prog=prog or f"python -m hil_mock_robot {name}",
            formatter_class=WithDefaults,
            description=f"{description} The mock accepts clients after it has printed `ready`, "
            "and runs until Ctrl-C.",
        )

    def add_arm(
        self, model: str, models: Sequence[str] | None, seed: int, *, start: str = "a safe pose"
    ) -> None:
        """Add the options of the arm: model, starting pose, payload.

        Args:
            model: Default model.
            models: Permitted models; None for any built-in arm and any arm description.
            seed: Default seed.
            start: Description of the default starting pose, for the help text.
        """
        add = self.add_argument
        add("--model", default=model, choices=models, help="arm to simulate")
        add("--seed", type=int, default=seed, help="seed of the random parameters of the arm")
        add(
            "--profile",
            default="full",
            choices=("full", "ideal"),
            help="physics: all effects, or ideal",
        )
        pose = f"initial joint angles in degrees, one per joint; {start} without this option"
        add("--start-q-deg", type=float, nargs="+", metavar="Q", help=pose)
        payload = (
            "true payload at the flange, independent of the declared one: mass, centre of mass [m]"
        )
        add("--mounted-kg", type=float, nargs=4, metavar=("KG", "X", "Y", "Z"), help=payload)

    def add_records(self) -> None:
        """Add the options for faults, journal and true parameters."""
        add = self.add_argument
        add("--faults", type=Path, help="YAML file with faults and their times")
        add("--journal", type=Path, help="file for a log of requests and events")
        truth = "write the true parameters to this file, for scoring"
        add(
            "--ground-truth",
            dest="truth",
            metavar="FILE",
            type=Path,
            help=truth if self.own else f"{truth}, without starting the mock",
        )


class WithDefaults(argparse.ArgumentDefaultsHelpFormatter):
    """Help formatter that shows only informative default values."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        shown = isinstance(default, str | int | float) and default is not False and default != ""
        return super()._get_help_string(action) if shown else action.help


def truth_of(given: argparse.Namespace) -> Truth:
    """Return the true parameters of the arm; write them to a file if `--ground-truth` is set."""
    truth = draw_truth(given.model, given.seed, given.profile)
    if given.truth:
        truth.to_json(given.truth)
    return truth


class Loop(Protocol):
    """Main loop that serves a mock."""

    def run(self) -> None:
        """Serve until `end` is called."""

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
    """Print the answer to `send` as JSON."""
    print(json.dumps(answer), flush=True)  # noqa: T201
    return 0


def exit_code_of(run: Callable[[], int]) -> int:
    """Run a mock and return its exit code; print errors to standard error."""
    try:
        return run()
    except HilError as error:
        hint = f"\n  next: {error.hint}" if error.hint else ""
        print(f"{type(error).__name__}: {error.message}{hint}", file=sys.stderr)  # noqa: T201
        return int(error.exit_code)
