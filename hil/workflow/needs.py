"""Check that program and robot provide what fits, studies and criteria need.

Checked before motion: a run with too few measurements for its fits, or with a criterion that cannot
be applied, would fail after hours.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from hil.core import HilError, KeyPath
from hil.dynamics import RobotModel, load_model
from hil.estimators import HONEST, Needs, estimator, gains_fault, needs_of
from hil.robot import Capabilities
from hil.spec import Excess, ExperimentSpec, Fourier, StationRobot
from hil.studies import study

MOST_LENGTHENED = 10_000
"""Largest number of poses or trajectories that the search for a sufficient program tries."""

CALIBRATED_LOADS = 3
"""Minimum number of loads to calibrate drive gains: no load, one load to calibrate with, one load
to judge."""

GAINS_HINT = (
    " → set drive_gain_nm_a in the arm description, or drive_gains_nm_a in the driver options if "
    "the driver has it"
)

Entry = tuple[KeyPath, str, Any]
"""Place of a name in the spec, the name, and the estimator or study of that name."""


class Size(NamedTuple):
    """How much a program measures.

    Attributes:
        spec: The experiment.
        motions: Different poses or trajectories.
        rate_hz: Of the recording.
    """

    spec: ExperimentSpec
    motions: int
    rate_hz: float

    @property
    def held(self) -> int:
        """Return how many of the motions no fit sees."""
        hold_out = self.spec.hold_out
        if isinstance(self.spec.excitation, Fourier):
            return hold_out.trajectories_of(self.motions)
        return hold_out.poses_of(self.motions)

    def amounts(self, *, after_hold_out: bool) -> dict[str, int]:
        """Return what a fit or a study sees, by the words of `Needs.least`.

        Args:
            after_hold_out: As a fit, which does not see what is held out; a study sees it all.
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
    """Return the unmet needs of the fits, studies and criteria of a spec.

    Plug-ins that state no needs are not refused.

    Args:
        spec: The experiment.
        robot: Capabilities of its driver.
        station_robot: The arm, and how it is mounted.
        motions: Different poses or trajectories of the program; None if they are not known.
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
    excesses = list(_criteria(spec, robot, [model for _, _, model in fits]))
    if size is not None and (excess := _held_out(size)) is not None:
        return [*excesses, excess]
    if not (fits or studies):
        return excesses
    model = load_model(station_robot.model, gravity=station_robot.gravity_m_s2)
    for one in (*fits, *studies):
        excesses += _of_one(one, spec, robot, model, size)
    return excesses


def _of_one(
    one: Entry,
    spec: ExperimentSpec,
    robot: Capabilities,
    model: RobotModel,
    size: Size | None,
) -> Iterator[Excess]:
    """Yield the unmet needs of an estimator or study."""
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
    """Return the shortest sufficient program as text; empty if none is found."""
    program = size.spec.excitation
    what = "excitation.trajectories" if isinstance(program, Fourier) else "excitation.waypoints"
    if getattr(program, "file", None) is not None:
        what = "poses in excitation.file"
    for motions in range(size.motions + 1, MOST_LENGTHENED + 1):
        longer = size._replace(motions=motions)
        if not needs.shortages(longer.amounts(after_hold_out=after_hold_out)):
            return f"; {what}: at least {motions}"
    return ""


def _held_out(size: Size) -> Excess | None:
    """Return the problem if the hold-out takes every pose of `excitation.file`; else None."""
    if not size.spec.fit or size.held < max(1, size.motions):
        return None
    message = f"holds out all {size.motions} poses of excitation.file and leaves none to fit on"
    return Excess(("validate", "hold_out"), message)


def _criteria(spec: ExperimentSpec, robot: Capabilities, models: list[Any]) -> Iterator[Excess]:
    """Yield the criteria that cannot be applied."""
    of_models = [key for key in ("rmse", "nrmse") if getattr(spec.accept, key) is not None]
    honest = any(getattr(model, "protocol", HONEST) == HONEST for model in models)
    for key in of_models if not honest else ():
        why = (
            "no model of `fit` is judged: all of them follow the protocol of a paper"
            if models
            else "there is no model to judge: `fit` is empty"
        )
        yield Excess(("accept", key), why)
    ratio = spec.accept.load_error_ratio
    if ratio is None or ratio.told != "calibrated":
        return
    path: KeyPath = ("accept", "load_error_ratio", "told")
    if robot.effort_kind != "current":
        yield Excess(path, f"{spec.robot} measures torques, so no drive gains are calibrated")
    elif len(spec.loads) < CALIBRATED_LOADS:
        yield Excess(path, "`loads` needs a third load to calibrate the drive gains with")
