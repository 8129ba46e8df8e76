"""An experiment: planned, run, resumed, studied and printed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.api.arguments import AnyPath, mapping, path, waivers_of
from hil.core.errors import SpecError
from hil.engine import Observer
from hil.planning.experiment import Experiment, load_experiment
from hil.planning.plan import Plan
from hil.workflow.confirmation import Confirm, Granted, Unconfirmed
from hil.workflow.desk import Desk, console_desk
from hil.workflow.run import RunReport, resume_experiment, run_experiment

if TYPE_CHECKING:
    from hil.studies.result import StudyResult


def load(
    spec: AnyPath,
    station: AnyPath | None = None,
    *,
    overrides: Mapping[str, object] | None = None,
) -> Experiment:
    """Load and check an experiment spec and its station.

    Args:
        spec: The spec's file.
        station: The station's file; by default as with `hil run`.
        overrides: Other values in the spec by dotted path (`excitation.waypoints`); texts are YAML,
            as those of `--set`.

    Raises:
        SpecError: With every problem of both files.
    """
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, default=_plain)
        for key, value in mapping(overrides, "overrides", "{'excitation.seed': 3}").items()
    }
    return load_experiment(path(spec), path(station) if station else None, texts)


def _loaded(experiment: Experiment) -> Experiment:
    """What `load` gives.

    Raises:
        SpecError: It is something else.
    """
    if isinstance(experiment, Experiment):
        return experiment
    raise SpecError(
        f"{experiment!r:.80} is no experiment", hint="load it first: hil.load('spec.yaml')"
    )


def _plain(value: object) -> object:
    """A number or list of numpy's as Python's own."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise SpecError(
        f"overrides: {value!r} is nothing that YAML has",
        hint="give numbers, texts, lists and mappings",
    )


def plan(experiment: Experiment, *, connect: bool = False) -> Plan:
    """What the robot would do; nothing moves.

    A robot on a virtual clock is asked where it stands. One in wall time is not connected to: its
    plan begins in the roomiest pose of its range.

    Args:
        experiment: From `load`.
        connect: Plan from where a robot in wall time stands now, too.

    Raises:
        PlanError: No safe plan follows from the spec.
        RobotError: The robot cannot be asked where it stands, or another process holds it.
    """
    from hil.report import plan_card  # noqa: F401  the card of a plan in a notebook has its picture
    from hil.workflow.preview import planned

    with planned(_loaded(experiment), connect=connect) as (_, made, _):
        return made


def run(
    experiment: Experiment,
    *,
    runs: AnyPath = "runs",
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
    robot: str | None = None,
) -> RunReport:
    """Plan, run, record, fit, judge and report.

    Args:
        experiment: From `load`.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the experiment's robot, which confirms that it may move; a real robot does
            not move without it.

    Returns:
        The report; a run that ended early says so in `outcome` and `error` and is not raised.

    Raises:
        NotConfirmed: The robot is real and was not named.
        SpecError: `robot` is not the robot of the experiment.
        HilError: What else went wrong before there was a run directory.
    """
    if robot not in (None, _loaded(experiment).spec.robot):
        raise SpecError(
            f"robot={robot!r} is not the robot of {experiment.spec.name}",
            hint=f"its robot is {experiment.spec.robot!r} of {experiment.station_source}",
        )
    return run_experiment(
        experiment,
        runs=path(runs),
        operator=operator,
        observers=observers,
        waivers=waivers_of(waivers),
        desk=_confirming(desk, robot, operator),
    )


def _confirming(desk: Desk | None, robot: str | None, operator: str) -> Desk:
    """Return the desk; the motion counts as confirmed if the call names the robot."""
    confirm: Confirm = Unconfirmed() if desk is None else desk.confirm
    if robot is not None:
        confirm = Granted("robot=", operator, {"robot": robot})
    return replace(desk or console_desk(operator), confirm=confirm)


def resume(
    run: AnyPath,
    *,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
    robot: str | None = None,
) -> RunReport:
    """Go on with a run that ended early: what is whole stays, the rest is measured and judged.

    Args:
        run: The run directory.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the run's robot, which confirms that it may move; needed for a real robot
            unless address, payload and all of the motion were confirmed when the run began.

    Returns:
        The report over all attempts.

    Raises:
        DataError: The run has nothing left to do, or its plan or spec was changed.
        PreflightFailed: It is another robot.
        NotConfirmed: Address or payload of a real robot changed, or the arm stands where the way
            back sweeps more than was confirmed, and `robot` does not name it.
        HilError: What else keeps the run from going on.
    """
    return resume_experiment(
        path(run), operator=operator, observers=observers,
        desk=_confirming(desk, robot, operator), waivers=waivers_of(waivers),
    )  # fmt: skip


def study(
    run: AnyPath,
    name: str | None = None,
    *,
    parameters: dict[str, Any] | None = None,
    watch: Callable[[str, str, int, int], None] | None = None,
) -> tuple[StudyResult, ...]:
    """Make the studies of a run's spec again, or another one; also refreshes its report.

    Args:
        run: The run directory.
        name: Name in `hil.studies`; by default all that the run's spec names.
        parameters: The study's own parameters, over those in the spec.
        watch: Told the study, what it is doing, and how many of how many steps of that are done.

    Returns:
        What they found, as it was written into the run directory.

    Raises:
        SpecError, PluginError: There is no such study or parameter.
        DataError, FitError: The run does not allow it; studies beside it have been made.
    """
    from hil.report import render_report
    from hil.workflow.studies import entries_for, run_studies, unwatched

    folder = path(run)
    given = mapping(parameters, "parameters", "{'seed': 3}")
    found = run_studies(folder, entries_for(folder, name, given), watch or unwatched)
    render_report(folder)
    if found.error is not None:
        raise found.error
    return tuple(result for _, result in found.made)


def figures(
    run: AnyPath, out: AnyPath, *, formats: Sequence[str] = ("pdf",), width: str = "column"
) -> list[Path]:
    """Write the figures of a run or a page, and tables of studies, as files for papers.

    Args:
        run: The run directory, or an HTML page that hil wrote.
        out: Folder for the files; made when missing.
        formats: Of the figures: `pdf`, `svg`, `png`.
        width: `column` (88 mm) or `page` (181 mm).

    Returns:
        What was written.

    Raises:
        PluginError: matplotlib is not installed.
        DataError: There is no figure, or a study or the page is damaged.
        SpecError: There is no such format or width.
    """
    from hil.report.paper import write_papers

    return write_papers(path(run), path(out), formats=formats, width=width)
