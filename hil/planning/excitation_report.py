"""Evaluation of the trajectories of an experiment, as printed by `hil optimise`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from hil.excitation import Appraisal, Information, margins_of
from hil.planning.experiment import Experiment
from hil.spec import Fourier


@dataclass(frozen=True, slots=True, eq=False)
class ExcitationReport:
    """Evaluation of the trajectories of an experiment.

    Attributes:
        experiment: Experiment to which the trajectories belong.
        appraisal: Evaluation of the trajectories of the experiment.
        random: Evaluation of the same number of random trajectories, each the best of a few random
            draws; None if the trajectories of the experiment are random.
        computed: Number of trajectories that were computed in this call; the other trajectories are
            from the cache.
        seconds: Computing time [s].
        notes: Texts with additional notes for the user.
    """

    experiment: Experiment
    appraisal: Appraisal
    random: Appraisal | None
    computed: int
    seconds: float
    notes: tuple[str, ...] = ()

    @property
    def spec(self) -> Fourier:
        """Excitation section of the experiment's spec."""
        assert isinstance(self.experiment.spec.excitation, Fourier)
        return self.experiment.spec.excitation

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil optimise --json`."""
        appraisal, random = self.appraisal, self.random
        number, closest = appraisal.closest
        asked = self.spec.optimise
        return {
            "name": self.experiment.spec.name,
            "robot": self.experiment.spec.robot,
            "optimise": None if asked is None else asked.model_dump(mode="json"),
            "joint_names": list(appraisal.joint_names),
            "computed": self.computed,
            "seconds": self.seconds,
            "trajectories": _trajectories(appraisal),
            "jointly": _told(appraisal.jointly),
            "margins": {name: each.tolist() for name, each in appraisal.margins.items()},
            "closest": {"trajectory": number, **closest._asdict()},
            "random": None
            if random is None
            else {"jointly": _told(random.jointly), "trajectories": _trajectories(random)},
            "standard_errors": self.standard_errors(),
            "notes": list(self.notes),
        }

    def standard_errors(self) -> dict[str, float] | None:
        """Return the ratio of the standard errors from random and from optimised trajectories.

        The keys of the returned mapping are the names of the parameters. The return value is None
        if there are no random trajectories for comparison.
        """
        if self.random is None:
            return None
        ours, theirs = self.appraisal.jointly, self.random.jointly
        ratio = theirs.standard_errors / ours.standard_errors
        return dict(zip(ours.names, ratio.tolist(), strict=True))


def _trajectories(appraisal: Appraisal) -> list[dict[str, Any]]:
    return [
        {
            "trajectory": number,
            **_told(trajectory.alone),
            "jointly": _told(trajectory.jointly),
            "closest": trajectory.closest._asdict(),
            "margins": {
                name: each.tolist()
                for name, each in margins_of(trajectory, appraisal.limits).items()
            },
            "series": trajectory.series.to_dict(),
        }
        for number, trajectory in enumerate(appraisal.trajectories)
    ]


def _told(information: Information) -> dict[str, Any]:
    return {
        "parameters": len(information.names),
        "condition_raw": information.condition_raw,
        "condition_scaled": information.condition_scaled,
        "singular_values": information.singular_values.tolist(),
    }
