"""The trajectories of an experiment, appraised before anything moves: `hil excite`."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from hil.core import SpecError
from hil.excitation import (
    Advance,
    Appraisal,
    FourierSeries,
    Limits,
    Roadmap,
    Setting,
    Watch,
    appraise,
    unwatched,
    user_cache,
)
from hil.planning import (
    ExcitationReport,
    Experiment,
    excesses,
    opened,
    plannable_arm,
    program_of,
    roadmap_of,
    setting_of,
    workspace_of,
)
from hil.spec import ExperimentSpec, Fourier


def appraise_excitation(
    experiment: Experiment, *, fresh: bool = False, watch: Watch = unwatched
) -> ExcitationReport:
    """Find an experiment's trajectories, or take them from the cache, and appraise them.

    The robot is not connected to.

    Args:
        experiment: What would be done, and where.
        fresh: Optimise again what the cache has.
        watch: Is told how far it is.

    Raises:
        SpecError: The excitation has no trajectories, or asks for more than the arm can do.
        PlanError: No motion does what the spec asks for.
    """
    spec = _with_trajectories(experiment.spec)
    with opened(spec.robot, experiment.robot) as robot:
        rate_hz = robot.capabilities.rate_hz
    arm = plannable_arm(experiment.robot)
    if problems := excesses(spec, arm, rate_hz, experiment.robot.surroundings.clearance_m):
        raise SpecError(
            "\n".join(map(str, problems)), hint="change these values, or take another robot"
        )
    workspace = workspace_of(spec, experiment.robot, arm, rate_hz)
    roadmap, heard = roadmap_of(workspace), _Heard(watch)
    cache = user_cache(fresh=fresh)
    setting = setting_of(spec, experiment.robot, arm, workspace, watch=heard, cache=cache)
    began = time.monotonic()
    motions = _trajectories_of(spec, roadmap, setting)
    seconds = time.monotonic() - began
    appraisal = _appraised(spec, roadmap, setting, motions)
    random = None
    if (drawn := _drawn(spec)) is not None:
        random = _appraised(spec, roadmap, setting, _trajectories_of(drawn, roadmap, setting))
    return ExcitationReport(
        experiment, appraisal, random, len(heard.computed), seconds, tuple(heard.notes)
    )


class _Heard:
    """Passes advances on, and remembers what was computed and noted."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        self.computed: set[int] = set()
        self.notes: list[str] = []

    def __call__(self, advance: Advance) -> None:
        if advance.note:
            self.notes.append(advance.note)
        else:
            self.computed.add(advance.trajectory)
        self._watch(advance)


def _with_trajectories(spec: ExperimentSpec) -> ExperimentSpec:
    if not isinstance(spec.excitation, Fourier):
        raise SpecError(
            f"{spec.name} is a {spec.excitation.kind} program, which has no trajectories",
            hint="`hil plan` shows what it does; `hil excite` is for excitation.kind: fourier",
        )
    return spec


def _drawn(spec: ExperimentSpec) -> ExperimentSpec | None:
    """The same spec with random trajectories; None where it has those already."""
    if getattr(spec.excitation, "optimise", None) is None:
        return None
    drawn = spec.excitation.model_copy(update={"optimise": None})
    return spec.model_copy(update={"excitation": drawn})


def _trajectories_of(
    spec: ExperimentSpec, roadmap: Roadmap, setting: Setting
) -> list[FourierSeries]:
    visits = program_of(spec, roadmap, setting).visits
    motions = [motion for visit in visits for motion in visit.motions]
    return [motion for motion in motions if isinstance(motion, FourierSeries)]


def _appraised(
    spec: ExperimentSpec, roadmap: Roadmap, setting: Setting, motions: Sequence[FourierSeries]
) -> Appraisal:
    assert isinstance(spec.excitation, Fourier)
    asked = spec.excitation.optimise
    return appraise(
        motions,
        roadmap.workspace,
        setting,
        limits_of(spec.excitation, roadmap, setting),
        rotor=asked is None or asked.rotor,
        friction=asked is not None and asked.friction,
    )


def limits_of(asked: Fourier, roadmap: Roadmap, setting: Setting) -> Limits:
    """What the trajectories of a spec have to keep to."""
    workspace, optimise = roadmap.workspace, asked.optimise
    ones = np.ones(len(workspace.joint_names))
    jerk = optimise.max_jerk_deg_s3 if optimise else None
    clearance_mm = optimise.clearance_mm if optimise else None
    return Limits(
        q_min=workspace.low,
        q_max=workspace.high,
        velocity=workspace.velocity * ones,
        acceleration=workspace.acceleration * ones,
        jerk=(np.inf if jerk is None else np.radians(jerk)) * ones,
        effort=(optimise.torque_percent / 100 if optimise else 1.0) * setting.effort_max,
        clearance_m=workspace.clearance_m if clearance_mm is None else 1e-3 * clearance_mm,
    )
