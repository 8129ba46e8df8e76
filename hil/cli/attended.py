"""What the command line says about whoever attends runs, and runs that are attended so."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hil.cli.live_view import live_view, recorded_capabilities
from hil.core import Rejected, SpecError

if TYPE_CHECKING:
    from hil.planning import Experiment
    from hil.robot import Capabilities
    from hil.workflow import Confirm, Moves, RunReport, Together


@dataclass(slots=True)
class Attended:
    """Who and what attends runs, as the command line says.

    Attributes:
        operator: Who is at the robot.
        answers: File with answers to all prompts.
        waive: `NAME=REASON` texts.
        wait_s: How long to wait for a robot that somebody else holds [s].
        live: Whether a live view is served, at which port and address.
        elsewhere: Whether prompts wait for answers from elsewhere.
        yes: Whether a real robot moves without a prompt.
        confirmed: File with the facts that were confirmed elsewhere.
        together: Confirmation of all runs of a series at once; None before it.
    """

    operator: str
    answers: Path | None
    waive: tuple[str, ...]
    wait_s: float
    live: tuple[bool, int | None, str | None]
    elsewhere: bool = False
    yes: bool = False
    confirmed: Path | None = None
    together: Together | None = None

    def confirm_together(self, moves: Moves) -> None:
        """Confirm all robots of a series or a fleet at once; its runs do not ask again."""
        from hil.workflow import confirm_together

        if self.confirmed is not None:  # it names robot and address itself
            moves.real()
            return
        self.together = confirm_together(moves, who=self.operator, yes=self.yes)

    def run(self, experiment: Experiment, runs: Path) -> RunReport:
        """Run an experiment."""
        from hil.workflow import checked_robot, run_experiment

        with checked_robot(experiment) as robot:
            confirm = self.together.begin(experiment) if self.together else self._confirm()
            move = partial(run_experiment, experiment, runs=runs, robot=robot)
            return self._attend(lambda: robot.capabilities, move, confirm)

    def resume(self, run: Path) -> RunReport:
        """Go on with a run."""
        from hil import api
        from hil.recording import RunDirectory

        robot = str(RunDirectory.open(run).start.get("robot_name", ""))
        # In a terminal its facts are shown again where what was confirmed then no longer holds.
        at_once = self.together if self.yes else None
        confirm = at_once.resume(robot, run) if at_once else self._confirm()
        return self._attend(lambda: recorded_capabilities(run), partial(api.resume, run), confirm)

    def _attend(
        self,
        robot: Callable[[], Capabilities],
        move: Callable[..., RunReport],
        confirm: Confirm | None,
    ) -> RunReport:
        from hil.cli.progress import ProgressLines
        from hil.workflow import console_desk

        desk = console_desk(
            self.operator,
            answers=self.answers,
            wait_s=self.wait_s,
            elsewhere=self.elsewhere,
            confirm=confirm,
        )
        with live_view(robot, *self.live) as views:
            return move(
                operator=self.operator,
                observers=(ProgressLines(), *views),
                waivers=waivers_of(self.waive),
                desk=desk,
            )

    def _confirm(self) -> Confirm | None:
        """Return the confirmation that replaces the console's; None for the console."""
        from hil.workflow import Granted, granted_in

        if self.confirmed is not None:
            return granted_in(self.confirmed)
        return Granted("--yes", self.operator) if self.yes else None


def rejected(report: RunReport) -> Rejected | None:
    """The error of a run whose model missed its criteria."""
    if report.verdict != "rejected":
        return None
    missed = f"the model of {report.run} missed its acceptance criteria"
    return Rejected(missed, hint=f"hil show {report.run}")


def waivers_of(texts: Iterable[str]) -> dict[str, str]:
    """`NAME=REASON` texts to a dict; a waiver without a reason is none."""
    pairs = [text.partition("=") for text in texts]
    for name, _, reason in pairs:
        if not (name and reason.strip()):
            raise SpecError(
                f"--waive {name!r} gives no reason",
                hint='for example: --waive "disk=the recording is short"',
            )
    return {name: reason.strip() for name, _, reason in pairs}
