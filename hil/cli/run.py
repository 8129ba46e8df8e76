"""`hil run` and `hil resume`: move the robot, attended by an operator.

The verbs `run` and `resume` share the options of `Attended`: the operator, the answers to prompts,
waivers, the confirmation of the motion, and the live view.
"""

import contextlib
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.live import resume_live
from hil.cli.options import (
    FirstOption,
    JsonFlag,
    OperatorOption,
    RunArgument,
    RunsOption,
    SetOption,
    SpecArgument,
    SpeedOption,
    StationOption,
    WaiveOption,
    YesFlag,
    load_experiment,
    refuse_set,
    waivers_of,
)
from hil.cli.output import fail, ignore_from_now_on, print_json, print_run
from hil.cli.series import rejected, resume_series, run_series
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.engine import Observer
    from hil.planning import Experiment
    from hil.robot import Capabilities
    from hil.workflow import Confirm, Moves, RunReport, Together

app = typer.Typer()


@dataclass(slots=True)
class Attended:
    """Options of attended runs, with methods that start and resume attended runs.

    Attributes:
        together: Common confirmation of all runs of a series; None before the confirmation.
    """

    operator: OperatorOption = ""
    answers: Annotated[
        Path | None,
        typer.Option(
            "--answers", help="YAML file with the answers to all prompts, for unattended runs."
        ),
    ] = None
    elsewhere: Annotated[
        bool,
        typer.Option(
            "--no-console",
            help="No prompts on this console: every prompt waits for `hil answer` or the "
            "dashboard, even on a mock.",
        ),
    ] = False
    waive: WaiveOption = None
    wait: Annotated[
        float,
        typer.Option(
            "--wait",
            min=0,
            metavar="SECONDS",
            help="Longest time to wait for a robot that another process has leased.",
        ),
    ] = 0.0
    yes: YesFlag = False
    confirmed: Annotated[
        Path | None,
        typer.Option(
            "--confirmed",
            metavar="FILE",
            help="JSON file with a confirmation of the motion, as written by the dashboard; a "
            "real robot moves only if the confirmation covers this run.",
        ),
    ] = None
    live: Annotated[
        bool,
        typer.Option("--live", help="Stream live data to Foxglove or Lichtblick on this computer."),
    ] = False
    live_port: Annotated[
        int | None,
        typer.Option(
            "--live-port",
            min=0,
            max=65535,
            metavar="PORT",
            show_default=False,
            help="Port of the live stream, 0 for any free port; default: 8765 or the next free "
            "port.",
        ),
    ] = None
    live_host: Annotated[
        str | None,
        typer.Option(
            "--live-host",
            metavar="ADDRESS",
            show_default=False,
            help="Address of the live stream, to serve other computers too. Every client that "
            "reaches the address can watch.",
        ),
    ] = None
    together: "Together | None" = field(default=None, init=False)

    def confirm_together(self, moves: "Moves") -> None:
        """Confirm all robots of a series together; the runs of the series do not ask again."""
        from hil.workflow import confirm_together

        if self.confirmed is not None:  # the file already names robot and address
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
        """Resume a run."""
        from hil import api
        from hil.recording import RunDirectory
        from hil.workflow import recorded_capabilities

        directory = RunDirectory.open(run)
        # In a terminal, changed facts are shown again for confirmation.
        at_once = self.together if self.yes else None
        robot = str(directory.start.get("robot_name", ""))
        confirm = at_once.resume(robot, run) if at_once else self._confirm()
        capabilities = partial(recorded_capabilities, directory)
        return self._attend(capabilities, partial(api.resume, run), confirm)

    def _attend(
        self,
        capabilities: "Callable[[], Capabilities]",
        move: "Callable[..., RunReport]",
        confirm: "Confirm | None",
    ) -> "RunReport":
        from hil.cli.progress import ProgressLines
        from hil.workflow import console_channel

        desk = console_channel(
            self.operator,
            answers=self.answers,
            wait_s=self.wait,
            remote=self.elsewhere,
            confirm=confirm,
        )
        with live_view(capabilities, self.live, self.live_port, self.live_host) as views:
            return move(
                operator=self.operator,
                observers=(ProgressLines(), *views),
                waivers=waivers_of(self.waive),
                desk=desk,
            )

    def _confirm(self) -> "Confirm | None":
        """Return the confirmation from the options; None if it is typed at the console."""
        from hil.workflow import Granted, granted_in

        if self.confirmed is not None:
            return granted_in(self.confirmed)
        return Granted("--yes", self.operator) if self.yes else None


@contextlib.contextmanager
def live_view(
    capabilities: "Callable[[], Capabilities]", live: bool, port: int | None, host: str | None
) -> "Iterator[tuple[Observer, ...]]":
    """Serve the live view within the context if one of the options requests this.

    Yields:
        Observers of the run, which receive its progress.

    Raises:
        PluginError: The live view cannot be served.
    """
    if not (live or port is not None or host):
        yield ()
        return
    from hil.engine import LAYOUT, LOOPBACK, FoxgloveLive
    from hil.robot import is_loopback

    host = host or LOOPBACK
    with FoxgloveLive(capabilities(), host=host, port=port) as view:
        typer.echo(f"live view: {view.url}\n   layout: {LAYOUT}", err=True)
        if not is_loopback(host):
            typer.secho(
                "  Warning: the live view has no password: every client that reaches the port can "
                "watch",
                err=True,
                fg=typer.colors.YELLOW,
            )
        yield (view,)


def with_attendance(verb: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `attended` of a verb by the options in `Attended`."""
    signature = inspect.signature(verb)
    shared = _shared_options()
    own = [
        option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for option in signature.parameters.values()
    ]
    place = next(number for number, option in enumerate(own) if option.name == "attended")

    @wraps(verb)
    def with_options(**values: Any) -> None:
        attended = Attended(**{name: values.pop(name) for name in shared})
        verb(**values, attended=attended)

    options = [*own[:place], *shared.values(), *own[place + 1 :]]
    vars(with_options)["__signature__"] = signature.replace(parameters=options)
    with_options.__annotations__ = {option.name: option.annotation for option in options}
    return with_options


@cache
def _shared_options() -> dict[str, inspect.Parameter]:
    return {
        option.name: option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for option in inspect.signature(Attended).parameters.values()
    }


@app.command()
@with_attendance
def run(
    spec: SpecArgument,
    station: StationOption = None,
    set_: SetOption = None,
    runs: RunsOption = Path("runs"),
    speed: SpeedOption = "",
    first: FirstOption = "",
    *,
    attended: Attended,
    json: JsonFlag = False,
) -> None:
    """Run an experiment or a series, from plan to report; options make first runs slow or short."""
    from hil.core import read_source
    from hil.planning import commissioning_of
    from hil.spec import is_schedule, is_series

    source = read_source(spec)
    if is_schedule(source):
        raise SpecError(
            f"{spec} is a schedule, not an experiment or a series",
            hint=f"execute it once: hil reidentify {spec}; or at its due times: "
            f"hil schedule run {spec}",
        )
    part = commissioning_of(speed, first)
    if is_series(source):
        refuse_set(set_, "a series")
        run_series(
            source,
            station,
            runs,
            part,
            lambda each: attended.run(each, runs),
            json,
            confirm=attended.confirm_together,
        )
        return
    experiment = replace(load_experiment(source, station, set_), commissioning=part)
    if not json:
        typer.echo(experiment.title, err=True)
    report = attended.run(experiment, runs)
    ignore_from_now_on()
    _print(report, json)


@app.command()
@with_attendance
def resume(
    run: RunArgument,
    runs: RunsOption = Path("runs"),
    *,
    attended: Attended,
    json: JsonFlag = False,
) -> None:
    """Resume a paused run, or complete an unfinished run in a new attempt."""
    from hil.core import is_live
    from hil.recording import SeriesGroup
    from hil.runs import find_run

    path = find_run(run, runs)
    if SeriesGroup.is_at(path):
        above = path.parents[2]
        resume_series(
            path,
            lambda each: attended.run(each, above),
            attended.resume,
            json,
            confirm=attended.confirm_together,
        )
        return
    if is_live(path):
        resume_live(path, attended.operator, json)
        return
    report = attended.resume(path)
    ignore_from_now_on()
    _print(report, json)


def _print(report: "RunReport", json: bool) -> None:
    if json:
        print_json(report.to_dict())
    else:
        print_run(report.run)
    if (error := report.error or rejected(report)) is not None:
        fail(error, json)
