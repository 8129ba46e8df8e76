"""The question an optimised trajectory answers: as a problem for the search, and as a hash."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import PlanError
from hil.excitation.cache import digest
from hil.excitation.motion import FourierSeries
from hil.excitation.optimiser import ExcitationProblem
from hil.excitation.setting import Setting
from hil.excitation.workspace import Workspace
from hil.spec import Fourier, Optimise

if TYPE_CHECKING:
    from hil.excitation.optimiser import ExcitationProblem

ANSWERS = 2
"""Raised whenever the same question gets another answer than before."""

TOLERANCE_M = 1e-9


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked of the trajectories of a spec in a workspace.

    Attributes:
        spec: Of the excitation; its `optimise` is given.
        workspace: Where the arm may be.
        setting: The robot.
        f_hz: Fundamental that ends trajectories on a sample.
    """

    spec: Fourier
    workspace: Workspace
    setting: Setting
    f_hz: float

    @property
    def asked(self) -> Optimise:
        """How to optimise."""
        assert self.spec.optimise is not None
        return self.spec.optimise

    @property
    def key(self) -> str:
        """A hash of everything the trajectories depend on but how many they are."""
        return digest(self._facts())

    def _facts(self) -> dict[str, Any]:
        workspace, asked = self.workspace, self.asked.model_dump(mode="json")
        return {
            "answers": ANSWERS,
            "optimise": asked | {"seed": self.seed},
            "series": [self.spec.harmonics, self.f_hz, self.spec.periods],
            "limits": [
                workspace.velocity,
                workspace.acceleration,
                self.clearance_m,
                *(each.tolist() for each in (workspace.low, workspace.high)),
                *(each.tolist() for each in (workspace.q_min, workspace.q_max)),
                self.setting.effort_max.tolist(),
            ],
            "rate_hz": workspace.rate_hz,
            "robot": self.setting.robot.to_dict(),
            "parameters": self.setting.robot.parameters().tolist(),
            "heaviest": repr(self.setting.heaviest),
            "place": dict(self.setting.identity),
        }

    @property
    def seed(self) -> int:
        """Of the search."""
        return self.spec.seed if self.asked.seed is None else self.asked.seed

    @property
    def clearance_m(self) -> float:
        """Distance that is kept [m].

        Raises:
            PlanError: It is less than the station's.
        """
        station = self.workspace.clearance_m
        if self.asked.clearance_mm is None:
            return station
        if 1e-3 * self.asked.clearance_mm < station - TOLERANCE_M:
            raise PlanError(
                f"excitation.optimise.clearance_mm: {self.asked.clearance_mm:g} mm is less than "
                f"the {1e3 * station:g} mm that the station asks for",
                hint="leave it out, or lower surroundings.clearance_m of the station's robot",
            )
        return 1e-3 * self.asked.clearance_mm

    def problem(self, found: Sequence[FourierSeries]) -> ExcitationProblem:
        """What the trajectory after those `found` has to be."""
        workspace, asked = self.workspace, self.asked
        jerk = asked.max_jerk_deg_s3
        problem = ExcitationProblem(
            robot=self.setting.robot.with_payload(self.setting.heaviest),
            q_min=workspace.low,
            q_max=workspace.high,
            qd_max=workspace.velocity,
            qdd_max=workspace.acceleration,
            jerk_max=None if jerk is None else float(np.radians(jerk)),
            effort_max=asked.torque_percent / 100 * self.setting.effort_max,
            harmonics=self.spec.harmonics,
            fundamental_hz=self.f_hz,
            periods=self.spec.periods,
            objective=asked.objective,
            scaled=asked.scaled,
            rotor=asked.rotor,
            friction=asked.friction,
            collision=self.setting.collision,
            space=workspace.space,
            clearance_m=self.clearance_m,
        )
        return problem.after(*found) if found else problem
