"""Summaries of fitted models, read from their folders (`FitFacts`).

A model folder `fit/<estimator>-<digest>` contains `model.json` and, after an evaluation,
`evaluation.json`. A model that was evaluated on several data sources yields one `FitFacts` per
source. No model is loaded and no value is computed again: a page shows the numbers that the
evaluation stored.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hil.core import FloatArray
from hil.report.documents import Document, as_float, as_names, as_object, as_objects, document
from hil.report.words import number, short_source

HONEST = "honest"
"""Copy of a constant in `hil.estimators.base`, because importing that module would load
Pinocchio.
"""

Part = Literal["held_out", "trained"]


@dataclass(frozen=True, slots=True)
class FitFacts:
    """Summary of one fitted model.

    Attributes:
        folder: Path of the model folder `fit/<estimator>-<digest>`.
        name: Name of the estimator. The digest is appended to the name if two folders have the same
            estimator, and a mark is appended if the model follows the protocol of a paper.
        label: Unique name for the page; the data source is appended to the name of the estimator if
            the model was evaluated on several sources.
        evaluation: Content of `evaluation.json`; empty if the model was not evaluated.
        model: Content of the file `model.json`.
        under_loads: Rows of the verdict of the run on this model with payloads.
    """

    folder: Path
    name: str
    label: str
    evaluation: Document
    model: Document
    under_loads: Sequence[Document] = ()

    @property
    def estimator(self) -> str:
        """Name under which the estimator is registered."""
        return _estimator_of(self.folder)

    @property
    def protocol(self) -> str:
        """Protocol `honest`, or a description of how the model departs from the honest protocol."""
        return _protocol(self.model, self.evaluation)

    @property
    def is_honest(self) -> bool:
        """Whether the model predicts without access to the target values."""
        return self.protocol == HONEST

    @property
    def held_out(self) -> Document:
        """Prediction errors on the hold-out set; empty if the model was not evaluated."""
        if "held_out" in self.evaluation:
            return as_object(self.evaluation["held_out"])
        return self.evaluation if "total" in self.evaluation else {}

    @property
    def trained(self) -> Document:
        """Prediction errors on the training data; empty if these errors are not stored."""
        return as_object(self.evaluation.get("trained"))

    @property
    def beside(self) -> Sequence[Document]:
        """Prediction errors on data with a new payload or a new motion only; without criteria."""
        return as_objects(self.evaluation.get("beside"))

    @property
    def above(self) -> str:
        """Lower limit of the high-frequency part of the signal, `12.5 Hz` for example, or empty."""
        cutoff = self.held_out.get("cutoff_hz")
        if not isinstance(cutoff, list) or not cutoff:
            return ""
        edges = dict.fromkeys(number(as_float(edge)) for edge in cutoff)
        return f"{'–'.join(edges)} Hz"

    @property
    def fast_part(self) -> str:
        """Description of `noise_floor`: signal that the filter removes, or dwell scatter."""
        if self.above:
            return f"part above {self.above}"
        if "cutoff_hz" in self.held_out:
            return "scatter within dwells"
        return "high-frequency part"

    @property
    def criteria(self) -> Sequence[Document]:
        """Rows of the verdict that concern this model."""
        return as_objects(as_object(self.evaluation.get("verdict")).get("rows"))

    @property
    def source(self) -> str:
        """Recording that the evaluation used; empty for the held-out part of a run."""
        return str(self.held_out.get("source") or "")

    @property
    def unit(self) -> str:
        """Unit of the effort, `A` or `N·m`; empty if unknown."""
        return str(self.held_out.get("unit", ""))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names, in the order of all values that are stored per joint."""
        return as_names(self.held_out.get("joint_names"))

    def total(self, part: Part = "held_out") -> Document:
        """Return the prediction errors over all rows of a part of the data."""
        return as_object((self.held_out if part == "held_out" else self.trained).get("total"))

    def mean(self, metric: str, part: Part = "held_out") -> float:
        """Return the mean of a metric over the joints for which it is defined; NaN if unknown.

        Two means are stored by the evaluation (`rmse_raw`, `rmse_filtered`) and are therefore read
        instead of computed.
        """
        stored = as_float(self.total(part).get(f"mean_{metric.removeprefix('rmse_')}"))
        if math.isfinite(stored):
            return stored
        known = self.values(metric, part)
        known = known[np.isfinite(known)]
        return float(known.mean()) if len(known) else float("nan")

    def values(self, metric: str, part: Part = "held_out") -> FloatArray:
        """Return the (n,) values of a metric per joint; NaN if undefined or not stored."""
        values = self.total(part).get(metric)
        if not isinstance(values, list) or len(values) != len(self.joint_names):
            return np.full(len(self.joint_names), np.nan)
        return np.array([as_float(value) for value in values])


def _estimator_of(folder: Path) -> str:
    return folder.name.rpartition("-")[0] or folder.name


def _protocol(model: Document, evaluation: Document) -> str:
    """Return the protocol that is stored with the model or the evaluation.

    Models of older versions of hil do not store a protocol and count as honest.
    """
    told = as_object(model.get("fitted")).get("protocol") or evaluation.get("protocol")
    return str(told or HONEST)


def model_folders(run: Path) -> list[Path]:
    """Return the folders `fit/<estimator>-<digest>` of all models of a run."""
    path = run / "fit"
    return sorted(item for item in path.iterdir() if item.is_dir()) if path.is_dir() else []


def read_fits(folders: Sequence[Path], problems: list[str]) -> tuple[FitFacts, ...]:
    """Return summaries of the models in the selected folders.

    A model that was evaluated on several data sources yields one summary per source.
    """
    names = [_estimator_of(folder) for folder in folders]
    labels = (
        name if names.count(name) == 1 else folder.name
        for name, folder in zip(names, folders, strict=True)
    )
    pairs = zip(folders, labels, strict=True)
    return tuple(fit for folder, label in pairs for fit in _fits_of_folder(folder, label, problems))


def _fits_of_folder(folder: Path, name: str, problems: list[str]) -> list[FitFacts]:
    evaluation = document(folder / "evaluation.json", problems)
    model = document(folder / "model.json", problems)
    if _protocol(model, evaluation) != HONEST:
        name = f"{name} (paper protocol)"
    sources = as_objects(evaluation.get("validation"))
    if not sources:
        return [FitFacts(folder, name, name, evaluation, model)]
    return [
        FitFacts(
            folder,
            name,
            f"{name} on {short_source(str(one.get('source')))}" if len(sources) > 1 else name,
            {"held_out": {"what": short_source(str(one.get("source"))), **one}},
            model,
        )
        for one in sources
    ]


def best_first(fits: Iterable[FitFacts]) -> tuple[FitFacts, ...]:
    """Return the fits with held-out errors: honest fits first, then by increasing raw RMSE."""

    def rank(fit: FitFacts) -> tuple[bool, bool, float]:
        error = fit.mean("rmse_raw")
        return not fit.is_honest, not math.isfinite(error), error

    return tuple(sorted((fit for fit in fits if fit.held_out), key=rank))
