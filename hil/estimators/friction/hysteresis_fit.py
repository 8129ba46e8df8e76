"""Learning a rigid body with friction that remembers; `learning` has the steps' machinery."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset, FilterSettings
from hil.dynamics import BaseParameters, RobotModel
from hil.estimators.checks import require_rank
from hil.estimators.consistent import InertialBounds
from hil.estimators.friction.law import FrictionLaw
from hil.estimators.friction.learning import Training, core_groups, rigid_of
from hil.estimators.friction.library import LEAST_LOAD, LOADED, Columns, groups, rungs
from hil.estimators.friction.motion import Shapes
from hil.estimators.friction.observed import Observed
from hil.estimators.friction.selection import AS_GOOD, Selection, climb
from hil.estimators.friction.series import temperatures_vary, usual_temperatures
from hil.estimators.friction.shapes import first_shapes, fitted_shapes
from hil.estimators.friction.solve import Solved, consistent, friction_ends, solve

NO_TRAJECTORIES = (
    "one trajectory only: friction columns were chosen on parts of it left out, which is less "
    "than a trajectory of its own"
)
WORSE = 1.2
"""Growth of a joint's error by bounds on links that people are told of."""

BACKBONE = ("load", "stribeck", "speed p")
"""Friction while shapes are looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """What a fit found; torques in N·m, see `RigidHysteresis`."""

    rigid: FloatArray
    gear_rigid: FloatArray
    inertial: FloatArray | None
    law: FrictionLaw
    held_out: FloatArray
    samples: int
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class HysteresisFit:
    """A robot to be learnt.

    Attributes:
        base: Its base parameters.
        robot: Nominal model.
        filters: Of the prepared data.
        turns: (n,) motor turns per joint turn, NaN where unknown.
    """

    base: BaseParameters
    robot: RobotModel
    filters: FilterSettings
    turns: FloatArray

    def learn(
        self,
        data: Dataset,
        scale: FloatArray,
        *,
        friction: str | Sequence[str],
        fit_shapes: bool,
        consistent: bool,
    ) -> Learnt:
        """From prepared data whose efforts make `scale` (n,) torque per unit."""
        training = Training.of(data, self.filters, self.robot, self.base, scale)
        ripple = bool(np.any(np.isfinite(self.turns)))
        library = groups(ripple=ripple, temperature=temperatures_vary(data))
        shapes, gear_rigid = self._shaped(training, library, fit_shapes)
        named, ladders = self._offered(training, library, friction, gear_rigid)
        observed = training.observed(named, gear_rigid, shapes)
        # Parts of one trajectory are no trajectories: there, richer must be better.
        found = climb(observed, ladders, as_good=AS_GOOD if training.whole else 0.0)
        solved = solve(observed, found.chosen, found.penalty)
        self._require_excited(solved)
        if consistent:
            solved = self._consistent(observed, found, solved)
        return Learnt(
            solved.rigid,
            gear_rigid,
            solved.inertial,
            FrictionLaw(found.chosen, solved.friction, shapes, usual_temperatures(data)),
            found.error * np.maximum(solved.grown, 1.0),
            int(training.kept.sum()),
            _notes(training, library, friction) + self._told(solved),
        )

    def _offered(
        self,
        training: Training,
        library: Mapping[str, Columns],
        friction: str | Sequence[str],
        gear_rigid: FloatArray,
    ) -> tuple[dict[str, Columns], list[list[tuple[str, ...]]]]:
        """Groups that are computed, and the lists every joint may choose from."""
        if friction != "auto":
            names = tuple(name for name in friction if name in library)
            return {name: library[name] for name in names}, [[names]] * self.robot.n
        ripple = bool(np.any(np.isfinite(self.turns)))
        ladder = rungs(ripple=ripple, temperature="temperature" in library)
        ladders = [
            ladder if share >= LEAST_LOAD else [_unloaded(names) for names in ladder]
            for share in training.load_share(gear_rigid)
        ]
        return {name: library[name] for name in ladder[-1]}, ladders

    def _shaped(
        self, training: Training, library: Mapping[str, Columns], fit_shapes: bool
    ) -> tuple[Shapes, FloatArray]:
        """Shapes, and the base parameters that tell the torque through the gears."""
        shapes = first_shapes(self.turns)
        rigid = rigid_of(training, core_groups(library, ["speed p"]), None, shapes)
        rigid = rigid_of(training, core_groups(library, BACKBONE), rigid, shapes)
        if fit_shapes:
            shapes = fitted_shapes(training.rest(rigid, shapes), shapes)
            rigid = rigid_of(training, core_groups(library, BACKBONE), rigid, shapes)
        return shapes, rigid

    def _consistent(self, observed: Observed, found: Selection, solved: Solved) -> Solved:
        bounds = InertialBounds.nominal(self.robot)
        return consistent(solved, self.base, bounds, friction_ends(observed, found.chosen))

    def _told(self, solved: Solved) -> tuple[str, ...]:
        """Notes on links at their bounds, and on what the bounds cost."""
        if solved.inertial is None:
            return ()
        bounds = InertialBounds.nominal(self.robot)
        notes = bounds.notes + bounds.reached(solved.inertial, self.robot.joint_names)
        worst = float(np.max(solved.grown))
        if worst > WORSE:
            joint = self.robot.joint_names[int(np.argmax(solved.grown))]
            notes += (
                f"links that can exist make the error of {joint} {worst:.2g} times larger: if the "
                "load and the robot's nominal model are right, try consistent: false",
            )
        return notes

    def _require_excited(self, solved: Solved) -> None:
        weighted = solved.weighted
        X, _ = weighted.weighted_system()
        names = (*self.base.names, *(f"friction {i}" for i in range(X.shape[1] - self.base.rank)))
        require_rank(weighted.rank, weighted.condition, names, X, highest=1e8)


def _unloaded(names: Sequence[str]) -> tuple[str, ...]:
    """The groups that do not grow with the torque through the gear."""
    return tuple(name for name in names if name not in LOADED)


def _notes(
    training: Training, library: Mapping[str, Columns], friction: str | Sequence[str]
) -> tuple[str, ...]:
    """What people should know about the choice of groups."""
    notes = [] if training.whole else [NO_TRAJECTORIES]
    missing = [] if friction == "auto" else [name for name in friction if name not in library]
    if missing:
        told = ", ".join(missing)
        notes.append(f"without motor turns or varying temperatures left out: {told}")
    return tuple(notes)
