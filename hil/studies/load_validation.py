"""Study of models with payloads: prediction errors, and a check of the declared payloads.

A payload changes the gravity, inertia and friction torques of the arm. The models are fitted with
the first payload only and tested on held-out motions with every payload. Each model is tested with
four kinds of payload information (Fig. 8b of the PINN paper has three): none, the declared payload,
the declared payload with drive gains corrected by means of the other payloads, and the payload
identified from other motions. The identified payload is also compared with the declared payload.
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
"""Default cut-off frequency [Hz]; a lower frequency is used if the sample rate is too low."""

FRICTIONS = ("auto", "model", "offset", "scale")

Failed = tuple[str, HilError]
"""Tuple of an estimator name and the error with which the fit failed."""


def _entries(name: str, given: Any) -> tuple[Entry, ...]:
    several = list(given) if isinstance(given, list | tuple) else [given]
    named = [one.get("estimator") if isinstance(one, Mapping) else one for one in several]
    if not isinstance(given, list | tuple) or not all(isinstance(one, str) for one in named):
        raise SpecError(
            f"{name} is {given!r}, but must be a list of names, or of mappings with a name",
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
        raise SpecError(f"{name} is {given!r}, but must not contain a name twice")
    return tuple(given)


class LoadValidation(Study):
    """Prediction errors of models with payloads, and a check of the declared payloads.

    Each error is computed for four kinds of payload information: unaware, declared, calibrated and
    identified.
    """

    study: ClassVar[str] = "load-validation"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",),)

    estimators: tuple[Entry, ...] = parameter(
        ("rigid-hysteresis",), _entries,
        doc="Estimators to fit with the first load: names, or mappings with parameters as in `fit` "
        "of a spec. The first estimator checks the declarations.",
    )  # fmt: skip
    models: tuple[str, ...] = parameter(
        (), _names,
        doc="Folders of fitted models to use instead of `estimators`; a folder of the run is "
        "relative to the run directory.",
    )  # fmt: skip
    hold_out: int | None = parameter(
        None, whole, at_least=1, optional=True,
        doc="Number of motions held out at a time; the models are fitted to the other motions. By "
        "default a quarter of the motions, or those that `models` of the run were not fitted to.",
    )  # fmt: skip
    friction: Friction | Literal["auto"] = parameter(
        "auto", choice, FRICTIONS,
        doc="Friction parameters that can change with the load, as in `estimate_payload`.",
    )  # fmt: skip
    false_alarm: float = parameter(
        FALSE_ALARM, number, above=0.0, at_most=0.5,
        doc="Maximum probability of contradicting a correct declaration.",
    )  # fmt: skip
    cutoff_hz: float | None = parameter(
        None, number, above=0.0, optional=True,
        doc="Cut-off frequency [Hz] of the zero-phase Butterworth filter of order 5 for the "
        "evaluation; by default 50 Hz, or the highest that the sample rate allows. The filters of "
        "the fits do not depend on it.",
    )  # fmt: skip
    rate_hz: float = parameter(
        125.0, number, above=0.0,
        doc="Sample rate [Hz] after filtering for the identification of the loads.",
    )  # fmt: skip
    figures: bool = parameter(True, flag, doc="Whether to draw figures.")

    def _check_together(self) -> None:
        if not (self.estimators or self.models):
            raise SpecError(
                "estimators is empty", hint="name at least one estimator, or a fitted model"
            )

    def extras(self) -> Mapping[str, str]:
        """Return the optional dependencies (extras) of the estimators."""
        fitted = () if self.models else self.estimators
        return {key: why for one in fitted for key, why in estimator_of(one).extras().items()}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the required data: at least three trajectories, and drive gains."""
        return NEEDS

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Return the tables, figures and summary sentences of the study.

        A failed estimator is reported in the warnings and does not affect the other estimators.

        Raises:
            FitError: There are too few trajectories, there is no second payload, or every fit
                fails.
            DataError: The data cannot be filtered with the selected cut-off frequency, or a model
                does not match the data.
            PluginError, SpecError: An estimator does not exist; in this case, no model has been
                fitted.
        """
        return self.told(*self.found(dataset, robot, progress))

    def found(
        self, dataset: Dataset, robot: RobotModel, progress: Progress = silent
    ) -> tuple[tuple[UnderLoads, ...], tuple[Failed, ...]]:
        """Return the results of the models in the requested order, and the models that failed.

        The first model that is fitted successfully checks the declared payloads.

        Raises:
            FitError, DataError, PluginError, SpecError: The study fails for one of the reasons
                listed for `run`.
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
        """Return the model results `found` as tables, figures and summary sentences."""
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
        """Return the protocol of the model for a fold, and the results of this fold."""
        model, cases = one.fitted(fold), load_cases(of, fold)
        scale = of.bare.scale
        return model.protocol, judged(model, cases, scale, self.friction, self.false_alarm)
