"""Checks of an experiment before planning: arm, driver, data for the fits, criteria and extras.

Without these checks, a run would fail only after hours, for example because of poses out of reach,
too few measurements for its fits, a criterion that cannot be applied, or a missing extra. No check
of the experiment connects to the robot.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from hil.arms import ArmDescription, is_described, load_arm
from hil.core import (
    HilError,
    KeyPath,
    Mark,
    Named,
    Problem,
    Source,
    SpecError,
    absent_extras,
    read_source,
    refuse,
    require_installed,
)
from hil.dynamics import RobotModel, load_model
from hil.estimators import HONEST, Needs, estimator, gains_fault, needs_of
from hil.excitation import WaypointFile, beyond_range, outside, read_waypoints, ways_out
from hil.planning import Experiment, declared_space, excesses, opened
from hil.robot import Capabilities, Robot
from hil.spec import Dwell, Excess, ExperimentSpec, Fourier, StationRobot, lay_over, misjudged
from hil.studies import study

POSES = ("excitation", "file")


def require_within_reach(experiment: Experiment, robot: Capabilities) -> None:
    """Raise if the arm cannot execute the spec, or if the run would give no result.

    A commissioning run is neither fitted nor evaluated, so only the limits of the arm are checked.

    Args:
        experiment: Experiment with spec and station.
        robot: Capabilities of the robot according to its driver, which may be unconnected.

    Raises:
        SpecError: The message has one line `file:line:column: path: message` per problem: a value
            beyond the limits of the arm; an invalid or unreachable pose in a waypoint file; a fit,
            study or criterion that lacks data, drive gains or models; a criterion in a unit that
            the robot does not measure.
        PluginError: An estimator or a study of the spec is missing.
    """
    spec, model = experiment.spec, experiment.robot.model
    judged = experiment.commissioning is None
    problems = misjudged(spec, robot.effort_kind) if judged else []
    arm = load_arm(model) if is_described(model) else None
    motions = getattr(spec.excitation, "trajectories", None)
    remedies: list[str] = []
    if arm is not None:
        clearance_m = experiment.robot.surroundings.clearance_m
        problems += excesses(spec, arm, robot.rate_hz, clearance_m)
    if isinstance(spec.excitation, Dwell):
        poses, faults, remedies = _poses(experiment, spec.excitation, robot.joint_names, arm)
        problems += faults
        motions = poses if not faults else None
    if judged:
        problems += unmet(spec, robot, experiment.robot, motions)
    if not problems:
        return
    source = _source_of(experiment)
    raise refuse(
        [Problem(source.mark(one.path), one.path, one.message) for one in problems],
        hint=", or ".join(["change these values", *remedies, "choose a different robot"]),
    )


def _poses(
    experiment: Experiment,
    program: Dwell,
    joint_names: tuple[str, ...],
    arm: ArmDescription | None,
) -> tuple[int, list[Excess], list[str]]:
    """Return the number of poses of a program, the problems of its waypoint file, and remedies."""
    if program.file is None:
        return program.waypoints, [], []
    try:
        file = read_waypoints(Path(program.file), joint_names, program.stated_unit)
    except SpecError as error:
        message = error.message.removeprefix("excitation.file: ")
        return 0, [Excess(POSES, f"{message} → {error.hint}")], []
    messages = list(file.problems)
    remedies: list[str] = []
    if arm is not None:
        beyond = _beyond_range(file, arm)
        # The workspace is checked only for poses within the joint range.
        near, remedies = ([], []) if beyond else _outside(file, arm, experiment)
        messages += beyond + near
    return len(file.q), [Excess(POSES, message) for message in messages], remedies


def _beyond_range(file: WaypointFile, arm: ArmDescription) -> list[str]:
    """Return a message for each pose that exceeds the joint range.

    If nearly all poses exceed the joint range, a single message states the suspected cause.
    """
    complaints = [beyond_range(q, arm.joint_names, arm.q_min, arm.q_max) for q in file.q]
    rows = [row for row, complaint in enumerate(complaints) if complaint]
    if suspicion := file.suspected(len(rows)):
        share = f"{len(rows)} of {len(file.q)} poses"
        return [f"{share} are beyond the range of a joint: {suspicion}"]
    return [f"{file.place(row)}: {complaints[row]}" for row in rows]


def _outside(
    file: WaypointFile, arm: ArmDescription, experiment: Experiment
) -> tuple[list[str], list[str]]:
    """Return messages for the poses outside the workspace, and possible remedies."""
    spec, clearance_m = experiment.spec, experiment.robot.surroundings.clearance_m
    space = declared_space(spec.interlocks, arm, [load.size_m for load in spec.loads])
    if space is None:
        return [], []
    complaints = [outside(space, q, clearance_m) for q in file.q]
    messages = [f"{file.place(row)}: {text}" for row, text in enumerate(complaints) if text]
    return messages, ways_out(space, file.q, clearance_m)


def _source_of(experiment: Experiment) -> Source:
    """Return the spec file with its overrides, which gives the positions in error messages.

    If there is no readable spec file, the returned source contains only the name of the spec.
    """
    if experiment.spec_source:
        with contextlib.suppress(SpecError):  # the file was changed after loading
            source = read_source(experiment.spec_source)
            lay_over(source, experiment.overrides)
            return source
    return Source(experiment.spec.name, values={(): Mark(experiment.spec.name, 0, 0)})


MOST_LENGTHENED = 10_000
"""Maximum number of poses or trajectories in the search for a sufficiently large program."""

CALIBRATED_LOADS = 3
"""Minimum number of loads that a spec needs to calibrate drive gains.

The three loads are no load, one load for the calibration and one load for the validation.
"""

GAINS_HINT = (
    " → set drive_gain_nm_a in the arm description, or drive_gains_nm_a in the driver options if "
    "the driver has this option"
)

Entry = tuple[KeyPath, str, Any]
"""Path of a plug-in name in the spec, the name, and the estimator or study with this name."""


class Size(NamedTuple):
    """Amount of data that a program measures, for the needs of fits and studies.

    Attributes:
        spec: Spec of the experiment.
        motions: Number of different poses or trajectories in the program.
        rate_hz: Sample rate of the recording [Hz].
    """

    spec: ExperimentSpec
    motions: int
    rate_hz: float

    @property
    def held(self) -> int:
        """Number of poses or trajectories in the hold-out set, which no fit uses."""
        hold_out = self.spec.hold_out
        if isinstance(self.spec.excitation, Fourier):
            return hold_out.trajectories_of(self.motions)
        return hold_out.poses_of(self.motions)

    def amounts(self, *, after_hold_out: bool) -> dict[str, int]:
        """Return the amount of data for a fit or a study, with the keys of `Needs.least`.

        Args:
            after_hold_out: Whether to exclude the hold-out set, as for a fit; a study uses all
                data.
        """
        motions, loads, program = self.motions, len(self.spec.loads), self.spec.excitation
        if after_hold_out:
            motions = max(0, motions - self.held)
            loads -= len(set(self.spec.hold_out.loads))
        if isinstance(program, Fourier):
            rows = round(program.periods / program.fundamental_hz * self.rate_hz)
            return {"trajectories": motions, "samples": motions * loads * rows}
        dwells = motions * loads * (2 if program.approach == "both" else 1)
        samples = dwells * program.samples_per_dwell
        return {"poses": motions, "dwells": dwells, "samples": samples}


def unmet(
    spec: ExperimentSpec, robot: Capabilities, station_robot: StationRobot, motions: int | None
) -> list[Excess]:
    """Return a message for each unmet need of the fits, studies and criteria of a spec.

    A plug-in that declares no needs is always accepted.

    Args:
        spec: Spec of the experiment.
        robot: Capabilities of the robot according to its driver.
        station_robot: Station entry of the arm, which contains its mounting orientation.
        motions: Number of different poses or trajectories of the program; None if unknown.
    """
    fits: list[Entry] = [
        (("fit", i, "estimator"), one.estimator, estimator(one.estimator, **one.parameters))
        for i, one in enumerate(spec.fit)
    ]
    studies: list[Entry] = [
        (("study", i, "study"), one.study, study(one.study, **one.parameters))
        for i, one in enumerate(spec.study)
    ]
    size = None if motions is None else Size(spec, motions, robot.rate_hz)
    problems = list(_unmet_criteria(spec, robot, [model for _, _, model in fits]))
    if size is not None and spec.fit and size.held >= max(1, size.motions):
        what = f"holds out all {size.motions} poses of excitation.file and leaves none for the fit"
        return [*problems, Excess(("validate", "hold_out"), what)]
    if not (fits or studies):
        return problems
    model = load_model(station_robot.model, gravity=station_robot.gravity_m_s2)
    for one in (*fits, *studies):
        problems += _unmet_needs(one, spec, robot, model, size)
    return problems


def _unmet_criteria(
    spec: ExperimentSpec, robot: Capabilities, models: list[Any]
) -> Iterator[Excess]:
    """Yield a message for each criterion that cannot be applied."""
    of_models = [key for key in ("rmse", "nrmse") if getattr(spec.accept, key) is not None]
    honest = any(getattr(model, "protocol", HONEST) == HONEST for model in models)
    for key in of_models if not honest else ():
        why = (
            "no model of `fit` is evaluated: all of them follow the protocol of a paper"
            if models
            else "there is no model to evaluate: `fit` is empty"
        )
        yield Excess(("accept", key), why)
    ratio = spec.accept.load_error_ratio
    if ratio is None or ratio.told != "calibrated":
        return
    path: KeyPath = ("accept", "load_error_ratio", "told")
    if robot.effort_kind != "current":
        yield Excess(path, f"{spec.robot} measures torques, so no drive gains are calibrated")
    elif len(spec.loads) < CALIBRATED_LOADS:
        yield Excess(path, "`loads` needs a third load for the calibration of the drive gains")


def _unmet_needs(
    one: Entry,
    spec: ExperimentSpec,
    robot: Capabilities,
    model: RobotModel,
    size: Size | None,
) -> Iterator[Excess]:
    """Yield a message for each unmet need of an estimator or study."""
    path, name, plug_in = one
    loaded = any(not load.payload().is_empty for load in spec.loads)
    try:
        needs = needs_of(plug_in, model, loaded=loaded)
    except HilError as error:
        yield Excess(path, f"{error.message} → {error.hint}" if error.hint else error.message)
        return
    if needs.effort and needs.effort != robot.effort_kind:
        measured = f"{spec.robot} measures a {robot.effort_kind}"
        yield Excess(path, f"{name} needs a {needs.effort}, but {measured}")
    elif needs.gains:
        fault = gains_fault(robot.effort_kind, robot.drive_gains, robot.joint_names)
        if fault is not None:
            yield Excess(path, f"{name} needs torques: {fault[0]}{GAINS_HINT}")
    fitted = path[0] == "fit"
    if size is not None and (short := needs.shortages(size.amounts(after_hold_out=fitted))):
        held = f" (held out: {size.held} of {size.motions})" if fitted and size.held else ""
        enough = _enough(needs, size, after_hold_out=fitted)
        yield Excess(path, f"{name}: {'; '.join(short)}{held}{enough}")


def _enough(needs: Needs, size: Size, *, after_hold_out: bool) -> str:
    """Return the shortest sufficient program as text; empty text if the search finds no program."""
    program = size.spec.excitation
    what = "excitation.trajectories" if isinstance(program, Fourier) else "excitation.waypoints"
    if getattr(program, "file", None) is not None:
        what = "poses in excitation.file"
    for motions in range(size.motions + 1, MOST_LENGTHENED + 1):
        longer = size._replace(motions=motions)
        if not needs.shortages(longer.amounts(after_hold_out=after_hold_out)):
            return f"; {what}: at least {motions}"
    return ""


def check_driver(experiment: Experiment) -> Capabilities:
    """Construct the driver without connecting to the robot; return the capabilities of the robot.

    Raises:
        SpecError, PluginError: The driver or the spec is not usable, see `checked_robot`.
    """
    with checked_robot(experiment) as robot:
        return robot.capabilities


@contextlib.contextmanager
def checked_robot(experiment: Experiment) -> Iterator[Robot]:
    """Open a robot without connecting, check that its arm can execute the experiment, close it.

    Raises:
        SpecError: The driver refuses its options (the message names the station file and the
            robot), or the arm cannot execute the spec (the message names every problem with its
            place in the spec file).
        PluginError: The driver does not exist, or cannot be loaded.
    """
    name = experiment.spec.robot
    place = f"{experiment.station_source}: robots.{name}"
    with contextlib.ExitStack() as until_closed:
        try:
            robot = until_closed.enter_context(opened(name, experiment.robot))
            can = robot.capabilities
        except SpecError as error:
            raise SpecError(f"{place}: {error.message}", hint=error.hint) from error
        except (TypeError, ValueError) as error:
            # Python raises these errors if the constructor does not have an option.
            options = ", ".join(experiment.robot.options) or "none"
            raise SpecError(
                f"{place}: the driver {experiment.robot.driver!r} does not accept its options "
                f"({options}): {error}",
                hint="see the driver's documentation for its options",
            ) from error
        require_within_reach(experiment, can)
        yield robot


def require_extras(spec: ExperimentSpec) -> None:
    """Raise if a run could be recorded, but not fitted or studied, on this computer.

    Raises:
        PluginError: Extras are missing; the message lists all missing extras.
        SpecError: A fit or study has a parameter that no longer exists.
    """
    require_installed(_evaluators(spec))


def _evaluators(spec: ExperimentSpec) -> list[Named]:
    """Return the estimators and studies of a spec, each with its path in the spec."""
    return [
        *(
            (f"fit: {fit.estimator}", estimator(fit.estimator, **fit.parameters))
            for fit in spec.fit
        ),
        *((f"study: {one.study}", study(one.study, **one.parameters)) for one in spec.study),
    ]


def missing_extras(spec: ExperimentSpec) -> list[str]:
    """Return the error messages of `require_extras` as texts.

    This function does not raise if extras are missing, because a different computer may have these
    extras.
    """
    absent = absent_extras(_evaluators(spec))
    return [f'{what} → pip install "hil[{extra}]"' for what, extra in absent]
