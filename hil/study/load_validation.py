"""What models learned on the bare arm are worth under loads, and whether they are those declared.

A load changes gravity, inertia and friction. A model is judged on motions held out, under every
load, three ways (Fig. 8b of the PINN paper): nobody tells it of the load, it is told what was
declared, and it is told what other motions with the load say. The last also checks the declaration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from hil.data.dataset import Dataset, SeriesKind
from hil.data.splits import Group, Split
from hil.dynamics import RobotModel
from hil.errors import HilError, SpecError
from hil.identify.base import HONEST, RobotEstimator, estimator
from hil.identify.lm.settings import whole
from hil.identify.parameters import MOST_SEED, choice, flag, number
from hil.identify.payload_declared import FALSE_ALARM
from hil.identify.payload_problem import Friction
from hil.study import load_tables as tables
from hil.study.base import Progress, Study, silent
from hil.study.dynamic_data import held_out, highest_cutoff
from hil.study.inverse_cases import Recorded, recorded
from hil.study.load_cases import LoadCase, load_cases, unseen
from hil.study.load_score import UnderLoads, checked, scored
from hil.study.load_words import TEXT, summary, warnings
from hil.study.result import Part, StudyResult

HIGHEST_HZ = 50.0
"""Cut-off where nobody asks for another and the recording is quick enough."""

FRICTIONS = ("auto", "model", "offset", "scale")

Failed = tuple[str, HilError]
"""Name of an estimator, and why there is nothing of it."""


class LoadValidation(Study):
    """Errors under loads, unaware, declared and identified; declarations checked.

    Args:
        estimators: Fitted to the first load; the first of them checks the declarations.
        models: Folders of fitted models to take in their place; of a run, relative to it.
        friction: What of its friction may be another under a load, as in `estimate_payload`.
        false_alarm: Probability with which a correct declaration may be called wrong.
        cutoff_hz: Of the zero-phase Butterworth filter of order 5; by default 50 Hz, or as high as
            the recording allows.
        rate_hz: Samples a fit keeps per second after filtering.
        seed: Of the draw of the motions held out.
        figures: Whether to draw any.
    """

    study: ClassVar[str] = "load-validation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    def __init__(
        self,
        *,
        estimators: Sequence[str] = ("rigid-hysteresis",),
        models: Sequence[str] = (),
        friction: Friction | Literal["auto"] = "auto",
        false_alarm: float = FALSE_ALARM,
        cutoff_hz: float | None = None,
        rate_hz: float = 125.0,
        seed: int = 0,
        figures: bool = True,
    ) -> None:
        self.estimators = _words("estimators", estimators)
        self.models = _words("models", models)
        if not (self.estimators or self.models):
            raise SpecError("estimators is empty", hint="name at least one, or a fitted model")
        self.friction = choice("friction", friction, FRICTIONS)
        self.false_alarm = number("false_alarm", false_alarm, above=0.0, at_most=0.5)
        known = cutoff_hz is not None
        self.cutoff_hz = number("cutoff_hz", cutoff_hz, above=0.0) if known else None
        self.rate_hz = number("rate_hz", rate_hz, above=0.0)
        self.seed = whole("seed", seed, at_least=0, at_most=MOST_SEED)
        self.figures = flag("figures", figures)

    def extras(self) -> Mapping[str, str]:
        """What its estimators need."""
        fitted = () if self.models else self.estimators
        return {key: why for name in fitted for key, why in estimator(name).extras().items()}

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, figures and sentences; an estimator that fails is told, and costs no other.

        Raises:
            FitError: There are too few trajectories or no second load, or every fit fails.
            DataError: The data cannot be filtered as asked, or a model does not fit them.
        """
        return self.told(*self.found(dataset, robot, progress))

    def found(
        self, dataset: Dataset, robot: RobotModel, progress: Progress = silent
    ) -> tuple[tuple[UnderLoads, ...], tuple[Failed, ...]]:
        """What every model is worth, in the order asked for, and which there are not.

        The first that there is checks the declarations.

        Raises:
            FitError, DataError: As `run`.
        """
        of = recorded(dataset, robot, self._cutoff(dataset), self.rate_hz)
        models, held = self._models(of, robot)
        cases = load_cases(of, held)
        found: list[UnderLoads] = []
        failed: list[Failed] = []
        for done, (name, fitted) in enumerate(models):
            progress(f"judging {name} under loads", done, len(models))
            try:
                found.append(self._judged(name, fitted(), cases, of, check=not found))
            except HilError as error:
                failed.append((name, error))
        if not found:
            raise failed[0][1]
        return tuple(found), tuple(failed)

    def _cutoff(self, dataset: Dataset) -> float:
        data = dataset.of_kind("trajectory")
        if self.cutoff_hz is not None or not data.conditions:
            return self.cutoff_hz or HIGHEST_HZ
        return min(HIGHEST_HZ, highest_cutoff(data, self.rate_hz))

    def told(self, found: Sequence[UnderLoads], failed: Sequence[Failed]) -> StudyResult:
        """The same as tables, figures and sentences."""
        figures = tables.figures(found) if self.figures else ()
        shown = (tables.declarations(found[0]), tables.errors(found), tables.identified(found[0]))
        protocols = [one.protocol for one in found if one.protocol != HONEST]
        part = Part("Under loads", next(iter(protocols), HONEST), TEXT, shown, figures)
        return StudyResult(
            self.study,
            "Under loads: what models are worth, and are the loads those declared?",
            summary(found, self.false_alarm),
            (part,),
            self.get_params(),
            warnings=warnings(found, failed),
        )

    def _models(
        self, of: Recorded, robot: RobotModel
    ) -> tuple[Sequence[tuple[str, Callable[[], RobotEstimator]]], frozenset[Group]]:
        """Names and what gives the fitted models, and the motions to judge them on."""
        if self.models:
            stored, held = unseen([Path(model) for model in self.models], of, self.seed)
            return [(name, partial(_as_it_is, model)) for name, model in stored], held
        outer = held_out(of.bare, self.seed)
        fits = [(name, partial(_fit, name, outer, of, robot)) for name in self.estimators]
        return fits, frozenset(outer.held_out)

    def _judged(
        self, name: str, model: RobotEstimator, cases: Sequence[LoadCase], of: Recorded,
        *, check: bool,
    ) -> UnderLoads:  # fmt: skip
        loads = tuple(scored(model, case, of.bare.scale, self.friction) for case in cases)
        found = UnderLoads(name, model.protocol, loads)
        return replace(found, loads=checked(loads, self.false_alarm)) if check else found


def _as_it_is(model: RobotEstimator) -> RobotEstimator:
    return model


def _fit(name: str, outer: Split, of: Recorded, robot: RobotModel) -> RobotEstimator:
    fresh = estimator(name)
    if "filters" in fresh.get_params():
        fresh = estimator(name, filters=of.bare.filters)
    return fresh.fit(outer.train, robot)


def _words(name: str, given: Any) -> tuple[str, ...]:
    several = isinstance(given, list | tuple)
    if not several or not all(isinstance(word, str) and word for word in given):
        raise SpecError(
            f"{name} is {given!r}, but must be a list of names", hint=f"{name}: [first, second]"
        )
    if len(set(given)) < len(given):
        raise SpecError(f"{name} has {given!r}, of which one is there twice")
    return tuple(given)
