"""Check before planning that the arm can do what the spec asks, and that it can be judged."""

from __future__ import annotations

from pathlib import Path

from hil.arms import ArmDescription, is_described, load_arm
from hil.core import Mark, Problem, Source, SpecError, read_source, refuse
from hil.excitation import WaypointFile, beyond_range, outside, read_waypoints, ways_out
from hil.planning import Experiment, declared_space, excesses
from hil.robot import Capabilities
from hil.spec import Dwell, Excess, lay_over, misjudged
from hil.workflow.needs import unmet

POSES = ("excitation", "file")


def require_within_reach(experiment: Experiment, robot: Capabilities) -> None:
    """Raise if the arm cannot do what the spec asks, or if the run would give no result.

    A commissioning run is neither fitted nor judged: only the limits of the arm are checked.

    Args:
        experiment: What is asked.
        robot: What its driver says of itself; it need not be connected.

    Raises:
        SpecError: One line `file:line:column: path: message` per problem: a value beyond the
            arm's limits; an invalid or out-of-range pose in a file; a fit, study or criterion
            that lacks data, drive gains or models; a criterion in a unit that the robot does not
            measure.
        PluginError: An estimator or a study is missing.
    """
    spec, model = experiment.spec, experiment.robot.model
    judged = experiment.commissioning is None
    problems = misjudged(spec, robot.effort_kind) if judged else []
    arm = load_arm(model) if is_described(model) else None
    motions = getattr(spec.excitation, "trajectories", None)
    ways: list[str] = []
    if arm is not None:
        clearance_m = experiment.robot.surroundings.clearance_m
        problems += excesses(spec, arm, robot.rate_hz, clearance_m)
    if isinstance(spec.excitation, Dwell):
        poses, faults, ways = _poses(experiment, spec.excitation, robot.joint_names, arm)
        problems += faults
        motions = poses if not faults else None
    if judged:
        problems += unmet(spec, robot, experiment.robot, motions)
    if not problems:
        return
    source = _source_of(experiment)
    raise refuse(
        [Problem(source.mark(one.path), one.path, one.message) for one in problems],
        hint=", or ".join(["change these values", *ways, "take another robot"]),
    )


def _source_of(experiment: Experiment) -> Source:
    """The file with its overrides, for the places in it; a spec without one is named."""
    if experiment.spec_source:
        try:
            source = read_source(experiment.spec_source)
            lay_over(source, experiment.overrides)
        except SpecError:  # changed since it was loaded
            pass
        else:
            return source
    return Source(experiment.spec.name, values={(): Mark(experiment.spec.name, 0, 0)})


def _poses(
    experiment: Experiment,
    program: Dwell,
    joint_names: tuple[str, ...],
    arm: ArmDescription | None,
) -> tuple[int, list[Excess], list[str]]:
    """Return the number of poses of a program, the problems of its file, and what else helps."""
    if program.file is None:
        return program.waypoints, [], []
    try:
        file = read_waypoints(Path(program.file), joint_names, program.stated_unit)
    except SpecError as error:
        message = error.message.removeprefix("excitation.file: ")
        return 0, [Excess(POSES, f"{message} → {error.hint}")], []
    messages = list(file.problems)
    ways: list[str] = []
    if arm is not None:
        beyond = _beyond_range(file, arm)
        near, ways = ([], []) if beyond else _outside(file, arm, experiment)
        messages += beyond + near
    return len(file.q), [Excess(POSES, message) for message in messages], ways


def _beyond_range(file: WaypointFile, arm: ArmDescription) -> list[str]:
    complaints = [beyond_range(q, arm.joint_names, arm.q_min, arm.q_max) for q in file.q]
    rows = [row for row, complaint in enumerate(complaints) if complaint]
    if suspicion := file.suspected(len(rows)):
        share = f"{len(rows)} of {len(file.q)} poses"
        return [f"{share} are beyond the range of a joint: {suspicion}"]
    return [f"{file.place(row)}: {complaints[row]}" for row in rows]


def _outside(
    file: WaypointFile, arm: ArmDescription, experiment: Experiment
) -> tuple[list[str], list[str]]:
    """Return the poses that are outside the workspace, and what helps beside other poses."""
    spec, clearance_m = experiment.spec, experiment.robot.surroundings.clearance_m
    space = declared_space(spec.interlocks, arm, [load.size_m for load in spec.loads])
    if space is None:
        return [], []
    complaints = [outside(space, q, clearance_m) for q in file.q]
    messages = [f"{file.place(row)}: {text}" for row, text in enumerate(complaints) if text]
    return messages, ways_out(space, file.q, clearance_m)
