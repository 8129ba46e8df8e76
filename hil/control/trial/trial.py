"""A trial: a stored model on the simulated arm of a station, checked before anything moves."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.arms import Payload
from hil.control.rest_place import place_of
from hil.control.trial.arm import RATE_HZ, Bench, require_simulated
from hil.control.trial.gains import spring_for
from hil.control.trial.leading import HAND_FIRMNESS
from hil.control.trial.reference import SWINGS_DEG, Leading, leading_for, trajectory_for
from hil.control.trial.result import Trial
from hil.control.trial.runs import Progress, guidings, led_with, tracked_by
from hil.core import SpecError
from hil.estimators import RobotEstimator, load_model_file, require_torque
from hil.spec import StationRobot


@dataclass(frozen=True, slots=True)
class TrialPlace:
    """A model, and the simulated arm on which it is tried.

    Attributes:
        folder: Of the model.
        model: The model.
        bench: The arm, and what it carries.
        where: The arm in words.
        named: Whether its station was named.
    """

    folder: Path
    model: RobotEstimator
    bench: Bench
    where: str
    named: bool


def trial_place(
    folder: Path, station: Path | None, robot: str | None, load: Payload | None
) -> TrialPlace:
    """Return the simulated arm of a model; nothing moves.

    Args:
        folder: The model.
        station: Station file; by default the one experiments here would use.
        robot: Name in the station; by default its only robot of the model's kind.
        load: What is mounted, and told to the model.

    Raises:
        FitError: Nobody knows the model's torques.
        SpecError: The robot is no simulated one with torque control, or is another arm.
        DataError: The model cannot be read.
    """
    model = load_model_file(folder)
    require_torque(model)
    entry, found = place_of(model, station, robot)
    name, where = _named(found, entry)
    require_simulated(name, entry)
    bench = Bench(name, entry, load or Payload())
    return TrialPlace(folder, model, bench, where, named=" of " in where)


def run_trial(place: TrialPlace, seed: int, friction_share: float, progress: Progress) -> Trial:
    """Try a model on its simulated arm.

    Args:
        place: Model and arm.
        seed: Of the trajectory; counted apart from those of experiments.
        friction_share: Of the dry friction, compensated while a hand leads; below 1.
        progress: Is told what is being run.

    Raises:
        FitError: The model has no gravity.
        SpecError: Nobody named a station, and the mock there is otherwise is not the arm of the
            model; or an argument cannot be.
        PlanError: There is no clear motion.
    """
    begin = time.perf_counter()
    model, bench = place.model, place.bench
    helped, notes = guidings(model, bench, friction_share)
    progress("planning")
    way = leading_for(bench)
    with bench.arm(way.start) as arm:
        serial = arm.serial
    fitted_on = _same_individual(model, serial, named=place.named)
    reference = trajectory_for(bench, seed)
    pd = spring_for(model.robot_, reference.q[:: round(RATE_HZ / 20)])
    tracked = tracked_by(model, bench, reference, pd, progress)
    led = led_with(helped, model, bench, way, pd.firmer(HAND_FIRMNESS), progress)
    told = (*_about(model, serial, fitted_on), *notes, *_short_ways(way, model.joint_names_))
    return Trial(
        str(place.folder), model.estimator, place.where, serial, fitted_on, model.joint_names_,
        bench.payload, seed, friction_share, pd, tracked, way, led,
        time.perf_counter() - begin, told,
    )  # fmt: skip


def _same_individual(model: RobotEstimator, serial: str, *, named: bool) -> str:
    """Serial number of the arm the model was fitted on.

    Raises:
        SpecError: It is another one than `serial`, which nobody has asked for.
    """
    known = model.training_.serial if model.training_ else ""
    if known and known != serial and not named:
        raise SpecError(
            f"the model was fitted on {known}, but no station was named, and the mock there is "
            f"otherwise is another individual ({serial})",
            hint="--station FILE --robot NAME, with the arm the model was fitted on",
        )
    return known


def _about(model: RobotEstimator, serial: str, fitted_on: str) -> Iterator[str]:
    """What makes all figures mean something else."""
    if fitted_on and fitted_on != serial:
        yield (
            f"ANOTHER INDIVIDUAL: the model was fitted on {fitted_on}, and tried on {serial}, "
            "which has other masses and friction; the figures are not its worth on its own arm"
        )
    if not any("trajectory" in kinds for kinds in model.series_kinds):
        yield (
            f"a static model: {model.estimator} was fitted to arms at rest, and all that it gives "
            "ahead is gravity; it knows neither inertia nor the friction of motion"
        )


def _short_ways(way: Leading, names: tuple[str, ...]) -> Iterator[str]:
    """Joints that are led by less than the others, and why."""
    least = np.radians(abs(SWINGS_DEG[0])) * (1 - 1e-6)
    if short := [
        f"{name} {np.degrees(abs(swing)):.3g}°"
        for name, swing in zip(names, way.swing, strict=True)
        if abs(swing) < least
    ]:
        yield (
            f"led by less than {abs(SWINGS_DEG[0]):g}°, so as to keep clear alone and all "
            f"together: {', '.join(short)}"
        )


def _named(where: str, robot: StationRobot) -> tuple[str, str]:
    """The robot's name, which is part of a mock's serial number, and where it is in words."""
    name, told, _ = where.partition(" of ")
    alone = robot.model.replace("@", "_")
    return (name, where) if told else (alone, f"a mock {robot.model} (no station was named)")
