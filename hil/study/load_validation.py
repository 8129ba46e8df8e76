"""What a model learned on the bare arm is worth under loads, and whether they are those declared.

A load changes gravity, inertia and friction. A model is judged on motions held out, under every
load, three ways (Fig. 8b of the PINN paper): nobody tells it of the load, it is told what was
declared, and it is told what other motions with the load say. The last also checks the declaration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from hil.data.dataset import Dataset, SeriesKind
from hil.data.splits import Group
from hil.dynamics import RobotModel
from hil.errors import SpecError
from hil.identify.base import RobotEstimator, estimator
from hil.identify.lm.settings import whole
from hil.identify.parameters import MOST_SEED, choice, flag, number
from hil.identify.payload_declared import FALSE_ALARM, check_declarations
from hil.identify.payload_problem import Friction
from hil.study import load_tables as tables
from hil.study.base import Progress, Study, silent
from hil.study.dynamic_data import held_out
from hil.study.inverse_cases import Recorded, recorded
from hil.study.load_cases import load_cases, unseen
from hil.study.load_score import Scored, scored
from hil.study.load_words import TEXT, summary, warnings
from hil.study.result import Part, StudyResult

FRICTIONS = ("auto", "model", "offset", "scale")


class LoadValidation(Study):
    """Errors under loads, unaware, declared and identified; declarations checked.

    Args:
        estimator: Fitted to the first load.
        model: Folder of a fitted model to take in its place; empty: none.
        friction: What of its friction may be another under a load, as in `estimate_payload`.
        false_alarm: Probability with which a correct declaration may be called wrong.
        cutoff_hz: Of the zero-phase Butterworth filter of order 5.
        rate_hz: Samples a fit keeps per second after filtering.
        seed: Of the draw of the motions held out.
        figures: Whether to draw any.
    """

    study: ClassVar[str] = "load-validation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    def __init__(
        self,
        *,
        estimator: str = "rigid-hysteresis",
        model: str = "",
        friction: Friction | Literal["auto"] = "auto",
        false_alarm: float = FALSE_ALARM,
        cutoff_hz: float = 50.0,
        rate_hz: float = 125.0,
        seed: int = 0,
        figures: bool = True,
    ) -> None:
        self.estimator = _word("estimator", estimator)
        self.model = _word("model", model)
        self.friction = choice("friction", friction, FRICTIONS)
        self.false_alarm = number("false_alarm", false_alarm, above=0.0, at_most=0.5)
        self.cutoff_hz = number("cutoff_hz", cutoff_hz, above=0.0)
        self.rate_hz = number("rate_hz", rate_hz, above=0.0)
        self.seed = whole("seed", seed, at_least=0, at_most=MOST_SEED)
        self.figures = flag("figures", figures)

    def extras(self) -> Mapping[str, str]:
        """What its estimator needs."""
        return {} if self.model else estimator(self.estimator).extras()

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, a figure and sentences.

        Raises:
            FitError: There are too few trajectories or no second load, or the fit fails.
            DataError: The data cannot be filtered as asked, or the model does not fit them.
        """
        of = recorded(dataset, robot, self.cutoff_hz, self.rate_hz)
        progress("fitting without a load", 0, 1)
        model, held = self._model(of, robot)
        found = self._scored(model, of, held, progress)
        figures = (tables.by_load(found),) if self.figures else ()
        told = (tables.declarations(found), tables.errors(found), tables.identified(found))
        return StudyResult(
            self.study,
            "Loads: what a model of the bare arm is worth, and are they those declared?",
            summary(found, model.estimator, self.false_alarm),
            (Part("Under loads", model.protocol, TEXT, told, figures),),
            self.get_params(),
            warnings=warnings(found),
        )

    def _model(self, of: Recorded, robot: RobotModel) -> tuple[RobotEstimator, frozenset[Group]]:
        if self.model:
            return unseen(Path(self.model), of, self.seed)
        outer = held_out(of.bare, self.seed)
        fresh = estimator(self.estimator)
        if "filters" in fresh.get_params():
            fresh = estimator(self.estimator, filters=of.bare.filters)
        return fresh.fit(outer.train, robot), frozenset(outer.held_out)

    def _scored(
        self, model: RobotEstimator, of: Recorded, held: frozenset[Group], progress: Progress
    ) -> Sequence[Scored]:
        cases = load_cases(of, held)
        found = []
        for done, case in enumerate(cases):
            progress(f"judging {case.name}", done, len(cases))
            found.append(scored(model, case, of.bare.scale, self.friction))
        return _checked(found, self.false_alarm)


def _checked(found: Sequence[Scored], false_alarm: float) -> list[Scored]:
    """With every declaration judged, gains told by the other loads."""
    known = [one for one in found if one.estimate is not None]
    declared = [one.case.declared for one in known]
    estimates = [one.estimate for one in known if one.estimate is not None]
    checks = iter(check_declarations(declared, estimates, false_alarm=false_alarm))
    return [one if one.estimate is None else replace(one, check=next(checks)) for one in found]


def _word(name: str, given: Any) -> str:
    if not isinstance(given, str):
        raise SpecError(f"{name} is {given!r}, but must be text")
    return given
