"""What models learned on the bare arm are worth under loads, and whether they are those declared.

A load changes gravity, inertia and friction. A model is judged on motions held out, under every
load, four ways (Fig. 8b of the PINN paper has three): nobody tells it of the load; it is told what
was declared; that, with drive gains as the other loads tell them; what other motions with the load
say. The last also checks the declaration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from hil.core import HilError, SpecError
from hil.data import Dataset, SeriesKind
from hil.dynamics import RobotModel
from hil.estimators import (
    FALSE_ALARM,
    HONEST,
    Friction,
    Needs,
    choice,
    flag,
    number,
    parameter,
    whole,
)
from hil.studies import load_tables as tables
from hil.studies.base import Progress, Study, silent
from hil.studies.dynamic_methods import NEEDS, highest_cutoff
from hil.studies.inverse_cases import Recorded, recorded
from hil.studies.load_models import (
    Candidate,
    Entry,
    Fold,
    Scored,
    UnderLoads,
    estimator_of,
    fresh_models,
    judged,
    load_cases,
    stored_models,
)
from hil.studies.load_tables import TEXT, summary, title, warnings
from hil.studies.result import Part, StudyResult

HIGHEST_HZ = 50.0
"""Cut-off where nobody asks for another and the recording is quick enough."""

FRICTIONS = ("auto", "model", "offset", "scale")

Failed = tuple[str, HilError]
"""Name of an estimator, and why there is nothing of it."""


def _entries(name: str, given: Any) -> tuple[Entry, ...]:
    several = list(given) if isinstance(given, list | tuple) else [given]
    named = [one.get("estimator") if isinstance(one, Mapping) else one for one in several]
    if not isinstance(given, list | tuple) or not all(isinstance(one, str) for one in named):
        raise SpecError(
            f"{name} is {given!r}, but must be a list of names, or of mappings with one",
            hint=f"{name}: [first, {{estimator: second}}]",
        )
    _names(name, [one for one in several if isinstance(one, str)])
    return tuple(one if isinstance(one, str) else dict(one) for one in several)


def _names(name: str, given: Any) -> tuple[str, ...]:
    several = isinstance(given, list | tuple)
    if not several or not all(isinstance(word, str) and word for word in given):
        raise SpecError(
            f"{name} is {given!r}, but must be a list of names", hint=f"{name}: [first, second]"
        )
    if len(set(given)) < len(given):
        raise SpecError(f"{name} has {given!r}, of which one is there twice")
    return tuple(given)


class LoadValidation(Study):
    """Errors under loads: unaware, declared, calibrated and identified; declarations checked."""

    study: ClassVar[str] = "load-validation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    estimators: tuple[Entry, ...] = parameter(
        ("rigid-hysteresis",), _entries,
        doc="Fitted to the first load; the first of them checks the declarations. Names, or "
        "mappings with parameters as in `fit` of a spec.",
    )  # fmt: skip
    models: tuple[str, ...] = parameter(
        (), _names,
        doc="Folders of fitted models to take in their place; of a run, relative to it.",
    )  # fmt: skip
    hold_out: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="How many motions are judged at a time, by models fitted to the others; by default a "
        "quarter of them, or those that `models` of the run have not seen.",
    )  # fmt: skip
    friction: Friction | Literal["auto"] = parameter(
        "auto", choice, FRICTIONS,
        doc="What of its friction may be another under a load, as in `estimate_payload`.",
    )  # fmt: skip
    false_alarm: float = parameter(
        FALSE_ALARM, number, above=0.0, at_most=0.5,
        doc="Probability with which a correct declaration may be called wrong.",
    )  # fmt: skip
    cutoff_hz: float | None = parameter(
        None, number, above=0.0, optional=True,
        doc="Of the zero-phase Butterworth filter of order 5 for what is judged; by default 50 Hz, "
        "or as high as the recording allows. Fits filter as they always do.",
    )  # fmt: skip
    rate_hz: float = parameter(
        125.0, number, above=0.0,
        doc="Samples kept per second after filtering to identify loads from.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw any.")

    def _check_together(self) -> None:
        if not (self.estimators or self.models):
            raise SpecError("estimators is empty", hint="name at least one, or a fitted model")

    def extras(self) -> Mapping[str, str]:
        """What its estimators need."""
        fitted = () if self.models else self.estimators
        return {key: why for one in fitted for key, why in estimator_of(one).extras().items()}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what it cannot do without: three trajectories, and drive gains."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables, figures and sentences; an estimator that fails is told, and costs no other.

        Raises:
            FitError: There are too few trajectories or no second load, or every fit fails.
            DataError: The data cannot be filtered as asked, or a model does not fit them.
            PluginError, SpecError: There is no such estimator; nothing has been fitted.
        """
        return self.told(*self.found(dataset, robot, progress))

    def found(
        self, dataset: Dataset, robot: RobotModel, progress: Progress = silent
    ) -> tuple[tuple[UnderLoads, ...], tuple[Failed, ...]]:
        """What every model is worth, in the order asked for, and which there are not.

        The first that there is checks the declarations.

        Raises:
            FitError, DataError, PluginError, SpecError: As `run`.
        """
        of = recorded(dataset, robot, self._cutoff(dataset), self.rate_hz)
        every = self._candidates(dataset, of, robot)
        steps = [(one, fold) for one in every for fold in one.folds]
        found: list[UnderLoads] = []
        failed: list[Failed] = []
        done = 0
        for one in every:
            try:
                folds = []
                for fold in one.folds:
                    progress(f"judging {one.name} under loads", done, len(steps))
                    folds.append(self._judged(one, fold, of))
                    done += 1
                found.append(UnderLoads.of(one.name, folds[0][0], [fold for _, fold in folds]))
            except HilError as error:
                failed.append((one.name, error))
        if not found:
            raise failed[0][1]
        return tuple(found), tuple(failed)

    def _candidates(
        self, dataset: Dataset, of: Recorded, robot: RobotModel
    ) -> tuple[Candidate, ...]:
        if self.models:
            places = [Path(model) for model in self.models]
            return stored_models(places, dataset, of, robot, self.hold_out)
        return fresh_models(self.estimators, dataset, of, robot, self.hold_out)

    def _cutoff(self, dataset: Dataset) -> float:
        data = dataset.of_kind("trajectory")
        if self.cutoff_hz is not None or not data.conditions:
            return self.cutoff_hz or HIGHEST_HZ
        return min(HIGHEST_HZ, highest_cutoff(data, self.rate_hz))

    def told(self, found: Sequence[UnderLoads], failed: Sequence[Failed]) -> StudyResult:
        """The same as tables, figures and sentences."""
        figures = tables.figures(found) if self.figures else ()
        checks = (tables.declarations(found[0]), *tables.identified(found[0]))
        shown = (*checks, tables.errors(found))
        protocols = [one.protocol for one in found if one.protocol != HONEST]
        part = Part("Under loads", next(iter(protocols), HONEST), TEXT, shown, figures)
        return StudyResult(
            self.study,
            title(found, self.models),
            summary(found, self.false_alarm),
            (part,),
            self.get_params(),
            warnings=warnings(found, failed),
        )

    def _judged(self, one: Candidate, fold: Fold, of: Recorded) -> tuple[str, tuple[Scored, ...]]:
        """The protocol of a fold's model, and what it is worth."""
        model, cases = one.fitted(fold), load_cases(of, fold)
        scale = of.bare.scale
        return model.protocol, judged(model, cases, scale, self.friction, self.false_alarm)
