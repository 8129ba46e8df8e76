"""The Python API: what the command line does with experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

Every function is in `hil` as well.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from inspect import signature
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from hil.control import FRICTION_SHARE
from hil.core import DataError, SpecError
from hil.data import Dataset
from hil.engine import Observer
from hil.planning import Experiment, Plan, load_experiment
from hil.runs import describe_run, find_runs, list_runs
from hil.workflow import (
    Confirm,
    Desk,
    Granted,
    RunReport,
    Unconfirmed,
    console_desk,
)

if TYPE_CHECKING:
    from hil.arms import Payload
    from hil.control import RestReport, Trial
    from hil.estimators import PayloadEstimate
    from hil.evaluation import FitReport
    from hil.export import Written
    from hil.models import Registry
    from hil.networks import Watch
    from hil.studies import StudyResult

__all__ = [
    "AnyPath",
    "Experiment",
    "RunReport",
    "dataset",
    "describe_run",
    "estimate_payload",
    "evaluate",
    "export_data",
    "export_model",
    "figures",
    "find_runs",
    "fit",
    "import_recording",
    "list_runs",
    "load",
    "parse_parameters",
    "plan",
    "registry",
    "reidentify",
    "rest_poses",
    "resume",
    "run",
    "study",
    "try_out",
]


AnyPath = str | Path
AnyPayload: TypeAlias = "str | float | Payload"
"""`MASS` or `MASS,X,Y,Z` [kg, m], the mass alone as a number [kg], or a `hil.arms.Payload`."""


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
        for key, value in _mapping(overrides, "overrides", "{'excitation.seed': 3}").items()
    }
    return load_experiment(_path(spec), _path(station) if station else None, texts)


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
    from hil.workflow import planned

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
    from hil.workflow import run_experiment

    return run_experiment(
        experiment,
        runs=_path(runs),
        operator=operator,
        observers=observers,
        waivers=_waivers_of(waivers),
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
    from hil.workflow import resume_experiment

    return resume_experiment(
        _path(run), operator=operator, observers=observers,
        desk=_confirming(desk, robot, operator), waivers=_waivers_of(waivers),
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
    from hil.workflow import entries_for, run_studies, unwatched

    folder = _path(run)
    given = _mapping(parameters, "parameters", "{'seed': 3}")
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
    from hil.report import write_papers

    return write_papers(_path(run), _path(out), formats=formats, width=width)


def fit(
    sources: AnyPath | Iterable[AnyPath],
    *,
    estimator: str,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    gains: AnyPath | None = None,
    validate: AnyPath | Iterable[AnyPath] = (),
    parameters: dict[str, Any] | None = None,
    out: AnyPath = "models",
    page: AnyPath | None = None,
    checkpoints: AnyPath | None = None,
    watch: Watch | None = None,
) -> FitReport:
    """Fit an estimator to recordings and judge it on others.

    Args:
        sources: Run directories or MCAP files to fit on, or just one.
        estimator: Name in `hil.estimators`.
        robot: Built-in arm or URDF; by default what the data says.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload`; 0 for nothing
            mounted; by default what the data says.
        gains: File with `drive_gains_nm_a`; by default what the data says.
        validate: Held-out sources, or just one.
        parameters: The estimator's own parameters.
        out: Folder in which the model's folder is made.
        page: Also write an HTML report about the held-out sources here.
        checkpoints: Folder in which estimators that train networks keep their training, and from
            which they take it up again.
        watch: Told every epoch of such a training.
    """
    from hil.estimators import read_gains
    from hil.evaluation import fit_sources

    held_out, given = _paths(validate), _mapping(parameters, "parameters", "{'weighted': True}")
    if taken := sorted(given.keys() & signature(fit_sources).parameters.keys()):
        raise SpecError(
            f"{taken[0]} is no parameter of an estimator", hint=f"hil.fit(…, {taken[0]}=…)"
        )
    if page is not None and not held_out:
        raise SpecError(
            "a page shows how a model does on held-out recordings, and none was given",
            hint="name one: hil.fit(…, validate=…)",
        )
    result = fit_sources(
        _sources_of(sources),
        estimator=estimator,
        robot=robot,
        payload=_payload_of(payload),
        gains=read_gains(_path(gains)) if gains else None,
        validate=held_out,
        out=_path(out),
        watch=watch,
        checkpoints=None if checkpoints is None else _path(checkpoints),
        **given,
    )
    if page is not None:
        _fit_page(result, held_out, _path(page))
    return result


def _fit_page(result: FitReport, held_out: Iterable[Path], page: Path) -> None:
    from hil.evaluation import usable_part
    from hil.importers import load_source
    from hil.report import render_fit_report

    model = result.fitted.model
    data = {str(source): usable_part(load_source(source), model) for source in held_out}
    render_fit_report(result.fitted.folder, data, page)


def evaluate(model: AnyPath, sources: AnyPath | Iterable[AnyPath]) -> list[dict[str, Any]]:
    """Judge a saved model; one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or was among the model's training data.
    """
    from hil.evaluation import evaluate_sources

    return evaluate_sources(_path(model), _sources_of(sources))


def estimate_payload(
    model: AnyPath,
    sources: AnyPath | Iterable[AnyPath],
    *,
    friction: str = "auto",
    bare: AnyPath | Iterable[AnyPath] = (),
    gain_share: float | None = None,
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a saved model of the arm.

    A recording of an arm at rest tells mass and centre of mass, one of motion inertia as well.

    Args:
        model: Its folder.
        sources: Run directories or MCAP files recorded with that load, or just one.
        friction: What of the model's friction may differ on that day: nothing (`model`), an
            `offset` per joint, or an offset and a factor (`scale`); `auto` lets the recording
            choose, by stretches that are left out in turn. At rest it is `auto`.
        bare: At rest: the same program run with nothing mounted, nor declared; much smaller errors.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            0.05, or 0.01 where they were calibrated (`hil gains`); torques have none.

    Raises:
        DataError: A source cannot be read, is of another robot, or was fitted to.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or `bare` was given with motion.
    """
    from typing import cast

    from hil.evaluation import payload_of_sources

    return payload_of_sources(
        _path(model), _paths(sources), cast("Any", friction),
        bare=_paths(bare), gain_share=gain_share,
    )  # fmt: skip


def dataset(*sources: AnyPath | Iterable[AnyPath]) -> Dataset:
    """The samples of run directories or MCAP files, with their conditions.

    Args:
        sources: One or more, or lists of them, of one robot and one kind of effort.

    Returns:
        Columns of N rows by name: `t` (N,) [s]; `q` (N, n) [rad], `qd` (N, n) [rad/s], `effort`
        (N, n) [A or N·m] and what else was recorded.

    Raises:
        DataError: None was given, one cannot be read, or they are of different robots.
        SpecError: One is no path.
    """
    from hil.importers import load_source

    return Dataset.concatenate([load_source(source) for source in _sources_of(*sources)])


def export_data(source: AnyPath, out: AnyPath) -> dict[str, Any]:
    """Write the samples of a run for other programs: one row each, nothing rounded.

    Args:
        source: Run directory or MCAP file.
        out: `….parquet`, `….csv` or `….npz`.

    Returns:
        `files`, `samples`, `series`, `columns`, `notes`.

    Raises:
        DataError: The source cannot be read, or no format is called so.
        PluginError: Parquet without pyarrow.
        RecordingError: A file is there already, or cannot be written.
    """
    from hil.importers import export_data as exported

    return exported(_path(source), _path(out)).to_dict()


def import_recording(
    file: AnyPath,
    *,
    map_file: AnyPath,
    out: AnyPath,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: AnyPayload | None = None,
) -> dict[str, Any]:
    """Turn a recording of another tool into our MCAP.

    Args:
        file: What to import.
        map_file: YAML that says what its columns are.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1, both included; the map's windows do not apply.
        drop_bad_rows: Leave rows out that make no sense instead of refusing.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that was mounted; 0
            for nothing; by default what the map says.

    Raises:
        SpecError: The map or the payload is not valid.
        DataError: The file holds rows that make no sense (with their line numbers).
    """
    from hil.importers import import_file

    report = import_file(
        _path(file),
        _path(map_file),
        out=_path(out),
        format_=format_,
        rows=rows,
        drop_bad_rows=drop_bad_rows,
        payload=_payload_of(payload),
    )
    return report.to_dict()


def registry(folder: AnyPath = "registry") -> Registry:
    """Models under names, in versions: who is champion, who was, and why.

    Args:
        folder: Made when something is registered.
    """
    from hil.models import Registry

    return Registry(_path(folder))


def reidentify(
    schedule: AnyPath,
    *,
    station: AnyPath | None = None,
    runs: AnyPath = "runs",
    registry: AnyPath = "registry",
    state: AnyPath | None = None,
    campaign: bool = False,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], object] | None = None,
) -> dict[str, Any]:
    """Do once, now, what a schedule is about; goes on with what was cut off not too long ago.

    Args:
        schedule: Its file.
        station: In place of the one it names.
        runs: Where run directories are kept.
        registry: Where the champion is, and challengers go.
        state: Folder of the schedule; by default `schedules/NAME`.
        campaign: Run the full program whatever the probe says.
        observers: Receive progress events of the runs, each on its own thread.
        tell: Told what is begun, in a few words.

    Returns:
        `outcome` (`quiet`, `drift`, `promoted`, `kept`), `text`, `name`, `champion`, `before`,
        `challenger`, `drift`, `decision`, `errors`, `runs`, `folder`: see docs/reference/files.md.

    Raises:
        SpecError: With every problem of the schedule and the files it names.
        DataError: Another process does the same now.
        HilError: What keeps a stage from its end; the next call goes on there.
    """
    from hil.maintenance import run_once

    return run_once(
        _path(schedule),
        station=_path(station) if station else None,
        runs=_path(runs),
        registry=_path(registry),
        state=_path(state) if state else None,
        campaign=campaign,
        observers=observers,
        tell=tell or (lambda text: None),
    )


def export_model(
    model: AnyPath,
    out: AnyPath,
    *,
    to: str = "c",
    prefix: str | None = None,
    unchecked: bool | None = None,
) -> Written:
    """Write a saved model for other programs, compared with the model in Python first.

    Args:
        model: Its folder.
        out: The file or folder to be made.
        to: `c` and the other targets of `hil.export.targets`.
        prefix: What files and symbols of C begin with; by default `hil`.
        unchecked: Write C without a compiler to check it with, or a URDF however far off it is.

    Raises:
        DataError: The model cannot be read.
        FitError: It is of a kind that cannot be written so, or what was written does not agree.
        PluginError: Something it takes is not installed, such as a C compiler or cvxpy.
        RecordingError: The file or folder exists already.
        SpecError: There is no such target, or an option is none of it.
    """
    from hil.estimators import load_model_file
    from hil.export import export_model as export

    stored = load_model_file(_path(model))
    return export(stored, _path(out), to, prefix=prefix, unchecked=unchecked)


def rest_poses(
    model: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    clearance_mm: float | None = None,
    near_deg: Sequence[float] | None = None,
    count: int = 3,
    seed: int = 0,
    unchecked: bool = False,
) -> RestReport:
    """The poses in which a model's arm loads its brakes least.

    Args:
        model: Its folder.
        station: Says what stands around the arm; by default the one experiments here would use,
            or a table at its base.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted.
        clearance_mm: Distance that is kept; by default the station's.
        near_deg: Where the arm stands now, or would rather be [°].
        count: How many poses.
        seed: Of the search.
        unchecked: Leave clearance out, the only way for an arm without collision bodies.

    Raises:
        FitError: The model has no gravity, or cannot tell torques.
        SpecError: The robot is another arm, or an argument cannot be.
        PlanError: No pose is within limits and clear.
    """
    from hil.control import find_rest_poses

    return find_rest_poses(
        _path(model),
        station=_path(station) if station else None,
        robot=robot,
        payload=_payload_of(payload),
        clearance_mm=clearance_mm,
        near_deg=near_deg,
        count=_whole(count, "count", 1),
        seed=_whole(seed, "seed", 0),
        unchecked=unchecked,
    )


def try_out(
    model: AnyPath,
    out: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    seed: int = 0,
    friction_share: float = FRICTION_SHARE,
    progress: Callable[[str], object] | None = None,
) -> Trial:
    """What a model is worth to a controller, on a simulated arm driven by torque.

    Args:
        model: Its folder.
        out: Folder to make, with `report.html` and `try-out.json`.
        station: Has the simulated arm the model was fitted on; by default the station experiments
            here would use, or a mock of its kind.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted and
            told to the model.
        seed: Of the trajectory; counted apart from those of experiments.
        friction_share: Of the dry friction, compensated while a hand leads the arm; below 1.
        progress: Is told what is being run.

    Raises:
        SpecError: The robot is no simulated one with torque control, or is another arm; nobody
            named a station, and the mock there is otherwise is not the model's; an argument
            cannot be.
        FitError: The model has no gravity, or cannot tell torques.
        PlanError: There is no clear motion.
        RecordingError: The folder exists, or cannot be written.
    """
    from hil.control import run_trial
    from hil.estimators import json_bytes
    from hil.export import require_new, write_folder
    from hil.report import TRY_OUT_FILE, page_html, trial_page

    folder = _path(out)
    require_new(folder)
    trial = run_trial(
        _path(model),
        station=_path(station) if station else None,
        robot=robot,
        payload=_payload_of(payload),
        seed=_whole(seed, "seed", 0),
        friction_share=friction_share,
        progress=progress or (lambda text: None),
    )
    document = json_bytes(trial.to_dict()).decode()
    write_folder({TRY_OUT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial


def _path(given: AnyPath) -> Path:
    """One path.

    Raises:
        SpecError: It is none.
    """
    if isinstance(given, str | Path):
        return Path(given)
    raise SpecError(
        f"a path is wanted, not {given!r:.80}",
        hint="give it as text or pathlib.Path; that of a report is its `run`",
    )


def _paths(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """One path or several; a text is a path, not a row of letters.

    Raises:
        SpecError: They are none.
    """
    if isinstance(given, str | Path) or not isinstance(given, Iterable):
        return [_path(given)]
    return [_path(one) for one in given]


def _sources_of(*given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Paths of recordings, one at least.

    Raises:
        DataError: There is none.
        SpecError: They are no paths.
    """
    found = [one for some in given for one in _paths(some)]
    if not found:
        raise DataError(
            "no recording was given", hint="give a run directory or an MCAP file (hil.find_runs)"
        )
    return found


def _payload_of(given: AnyPayload | None) -> Payload | None:
    """A load, as `--payload` reads it; that of a mass alone is at the flange's origin.

    Returns:
        None when nothing was said; of 0, that nothing is mounted.

    Raises:
        SpecError: It is none.
    """
    if given is None:
        return None
    from hil.arms import Payload
    from hil.evaluation import parse_payload

    if isinstance(given, Payload):
        read = parse_payload(",".join(f"{number}" for number in (given.mass, *given.com)))
        return replace(read, inertia=given.inertia)
    return parse_payload(f"{given}")


def _mapping(given: Mapping[str, Any] | None, what: str, example: str) -> dict[str, Any]:
    """Values by name; none when nothing is given.

    Raises:
        SpecError: It is no mapping of names.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise SpecError(
            f"{what} is {given!r:.80}, not values by name", hint=f"for example: {example}"
        )
    return dict(given)


def _waivers_of(given: Mapping[str, str] | None) -> dict[str, str]:
    """Why which check's failure is accepted; a waiver without a reason is none.

    Raises:
        SpecError: They are no reasons by check.
    """
    example = "{'disk': 'another disk comes on Monday'}"
    waivers = _mapping(given, "waivers", example)
    for check, reason in waivers.items():
        if not (isinstance(reason, str) and reason.strip()):
            raise SpecError(
                f"the waiver of {check!r} gives no reason", hint=f"for example: waivers={example}"
            )
    return {check: reason.strip() for check, reason in waivers.items()}


def _whole(given: int, what: str, least: int) -> int:
    """A whole number.

    Raises:
        SpecError: It is none, or too small.
    """
    try:
        number = index(given)
    except TypeError:
        number = least - 1
    if number < least:
        raise SpecError(
            f"{what} is {given!r:.80}, not a whole number from {least} on",
            hint=f"for example: {what}={max(least, 3)}",
        )
    return number


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.core import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
