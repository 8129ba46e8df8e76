"""An arm with room all around it, and trajectories found without a search."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.dynamics import RobotModel
from hil.excitation.cache import ExcitationCache
from hil.excitation.fourier import FourierExcitation, Question, fitting_frequency
from hil.excitation.motion import FourierSeries
from hil.excitation.problem import ExcitationProblem
from hil.excitation.program import Advance, Setting
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import roomy_poses
from hil.spec.experiment import Fourier
from tests.support.plan_parts import JointSpace, toy_workspace

WORKSPACE = toy_workspace(n=6)
ROADMAP = Roadmap(WORKSPACE, roomy_poses(WORKSPACE, 16, seed=0))


class Found:
    """What the search gives back, as far as anybody asks here."""

    def __init__(self, series: FourierSeries) -> None:
        self.series = series


class Finder:
    """Stands in for the search: quick, and a different motion for every seed."""

    def __init__(self) -> None:
        self.problems: list[ExcitationProblem] = []

    def __call__(self, problem: ExcitationProblem, *, seed: int, **asked: Any) -> Found:
        self.problems.append(problem)
        drawn = {"kind": "fourier", "trajectories": 1, "seed": seed, "amplitude_deg": 40}
        (visit,) = FourierExcitation(Fourier.model_validate(drawn)).program(ROADMAP).visits
        (series,) = visit.motions
        assert isinstance(series, FourierSeries)
        return Found(series)


class Bench:
    """An arm, a folder for the cache, and what was told meanwhile."""

    def __init__(self, folder: Path, finder: Finder) -> None:
        self.folder, self.finder = folder, finder
        self.told: list[Advance] = []

    def trajectories(self, number: int = 1, *, fresh: bool = False, **optimise: Any) -> list[Any]:
        self.told.clear()
        self.finder.problems.clear()
        excitation = FourierExcitation(asked(number, **optimise))
        excitation.compute_with(self.setting(fresh=fresh))
        return [motion for visit in excitation.program(ROADMAP).visits for motion in visit.motions]

    def key(self, number: int = 1, **optimise: Any) -> str:
        spec = asked(number, **optimise)
        f_hz = fitting_frequency(spec, WORKSPACE.rate_hz)
        return Question(spec, WORKSPACE, self.setting(), f_hz).key

    def setting(self, *, fresh: bool = False) -> Setting:
        nothing: Any = JointSpace(lambda q: np.ones(len(q)))
        return Setting(
            robot=RobotModel.from_arm("ur5"),
            effort_max=np.full(6, 150.0),
            loads=(Payload(), Payload(2.0)),
            collision=nothing,
            identity={},
            cache=ExcitationCache(self.folder, fresh),
            watch=self.told.append,
        )

    @property
    def computed(self) -> int:
        return len(self.finder.problems)

    @property
    def notes(self) -> list[str]:
        return [advance.note for advance in self.told if advance.note]

    @property
    def entry(self) -> Path:
        (file,) = self.folder.glob("*.json")
        return file


def asked(number: int = 1, **optimise: Any) -> Fourier:
    return Fourier.model_validate({"kind": "fourier", "trajectories": number, "optimise": optimise})


@pytest.fixture
def finder(monkeypatch: pytest.MonkeyPatch) -> Finder:
    finder = Finder()
    monkeypatch.setattr("hil.excitation.fourier.optimise", finder)
    return finder


@pytest.fixture
def bench(tmp_path: Path, finder: Finder) -> Bench:
    return Bench(tmp_path / "cache", finder)
