"""The options of verbs that move a robot while somebody attends, and runs attended so."""

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.live_view import LiveFlag, LiveHost, LivePort, live_view, recorded_capabilities
from hil.core import Rejected, SpecError

if TYPE_CHECKING:
    from hil.planning import Experiment
    from hil.robot import Capabilities
    from hil.workflow import Confirm, Moves, RunReport, Together


OperatorOption = Annotated[str, typer.Option("--operator", help="Who is at the robot; recorded.")]
WaiveOption = Annotated[
    list[str] | None,
    typer.Option(
        "--waive", metavar="NAME=REASON", help="Accept a failed preflight check; recorded."
    ),
]
YesFlag = Annotated[
    bool,
    typer.Option(
        "--yes",
        help="Move a real robot without a prompt (for scripts). The confirmation is recorded in "
        "the run.",
    ),
]


@dataclass(slots=True)
class Attended:
    """Who and what attends runs: the options that `hil run` and `hil resume` share.

    Attributes:
        together: Confirmation of all runs of a series at once; None before it.
    """

    operator: OperatorOption = ""
    answers: Annotated[
        Path | None,
        typer.Option("--answers", help="Answers to all prompts (YAML), for runs nobody attends."),
    ] = None
    elsewhere: Annotated[
        bool,
        typer.Option(
            "--elsewhere",
            help="Nobody sits at this console: prompts, also those of a mock, wait for "
            "`hil answer` or the dashboard.",
        ),
    ] = False
    waive: WaiveOption = None
    wait: Annotated[
        float,
        typer.Option(
            "--wait",
            min=0,
            metavar="SECONDS",
            help="How long to wait for a robot that somebody else holds.",
        ),
    ] = 0.0
    yes: YesFlag = False
    confirmed: Annotated[
        Path | None,
        typer.Option(
            "--confirmed",
            metavar="FILE",
            help="JSON file with the confirmed facts of the motion, as written by the dashboard; "
            "a real robot moves only if they cover this run.",
        ),
    ] = None
    live: LiveFlag = False
    live_port: LivePort = None
    live_host: LiveHost = None
    together: "Together | None" = field(default=None, init=False)

    def confirm_together(self, moves: "Moves") -> None:
        """Confirm all robots of a series or a fleet at once; its runs do not ask again."""
        from hil.workflow import confirm_together

        if self.confirmed is not None:  # it names robot and address itself
            moves.real()
            return
        self.together = confirm_together(moves, who=self.operator, yes=self.yes)

    def run(self, experiment: "Experiment", runs: Path) -> "RunReport":
        """Run an experiment."""
        from hil.workflow import checked_robot, run_opened

        with checked_robot(experiment) as robot:
            confirm = self.together.begin(experiment) if self.together else self._confirm()
            move = partial(run_opened, experiment, robot, runs=runs)
            return self._attend(lambda: robot.capabilities, move, confirm)

    def resume(self, run: Path) -> "RunReport":
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
        robot: "Callable[[], Capabilities]",
        move: "Callable[..., RunReport]",
        confirm: "Confirm | None",
    ) -> "RunReport":
        from hil.cli.progress import ProgressLines
        from hil.workflow import console_desk

        desk = console_desk(
            self.operator,
            answers=self.answers,
            wait_s=self.wait,
            elsewhere=self.elsewhere,
            confirm=confirm,
        )
        with live_view(robot, self.live, self.live_port, self.live_host) as views:
            return move(
                operator=self.operator,
                observers=(ProgressLines(), *views),
                waivers=waivers_of(self.waive or ()),
                desk=desk,
            )

    def _confirm(self) -> "Confirm | None":
        """Return the confirmation that replaces the console's; None for the console."""
        from hil.workflow import Granted, granted_in

        if self.confirmed is not None:
            return granted_in(self.confirmed)
        return Granted("--yes", self.operator) if self.yes else None


@cache
def _shared_options() -> dict[str, inspect.Parameter]:
    return {
        option.name: option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for option in inspect.signature(Attended).parameters.values()
    }


def with_attendance(verb: Callable[..., None]) -> Callable[..., None]:
    """Give a verb the options of `Attended` in place of its parameter `attended`."""
    signature = inspect.signature(verb)
    shared = _shared_options()
    own = [
        option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for option in signature.parameters.values()
    ]
    place = next(number for number, option in enumerate(own) if option.name == "attended")

    @wraps(verb)
    def with_options(**given: Any) -> None:
        attended = Attended(**{name: given.pop(name) for name in shared})
        verb(**given, attended=attended)

    options = [*own[:place], *shared.values(), *own[place + 1 :]]
    vars(with_options)["__signature__"] = signature.replace(parameters=options)
    with_options.__annotations__ = {option.name: option.annotation for option in options}
    return with_options


def rejected(report: "RunReport") -> Rejected | None:
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
