"""Fitted models as their folders describe them: `FitFacts`.

A model folder, `fit/<estimator>-<digest>`, holds `model.json` and, once the model was judged,
`evaluation.json`. A model judged on several sources is one `FitFacts` for each of them. Nothing
is loaded or computed: the numbers on a page are those the evaluation has stored.
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
"""As in `hil.estimators.base`, which would load Pinocchio to show a few numbers."""

Part = Literal["held_out", "trained"]


@dataclass(frozen=True, slots=True)
class FitFacts:
    """One fitted model.

    Attributes:
        folder: `fit/<estimator>-<digest>`.
        name: The estimator's name, with the digest where two folders have the same estimator, and
            with a mark where the model follows a paper's protocol.
        label: The name, with the source where the model was judged on several.
        evaluation: Content of `evaluation.json`, empty when it was not evaluated.
        model: Content of `model.json`.
        under_loads: Rows of its run's verdict about loads.
    """

    folder: Path
    name: str
    label: str
    evaluation: Document
    model: Document
    under_loads: Sequence[Document] = ()

    @property
    def estimator(self) -> str:
        """As registered."""
        return _estimator_of(self.folder)

    @property
    def protocol(self) -> str:
        """`honest`, or how the model departs from that."""
        return _protocol(self.model, self.evaluation)

    @property
    def is_honest(self) -> bool:
        """Whether the model predicts without seeing the target."""
        return self.protocol == HONEST

    @property
    def held_out(self) -> Document:
        """Errors on data the model has not seen; empty when there are none."""
        if "held_out" in self.evaluation:
            return as_object(self.evaluation["held_out"])
        return self.evaluation if "total" in self.evaluation else {}

    @property
    def trained(self) -> Document:
        """Errors on the data the model was fitted to; empty when not stored."""
        return as_object(self.evaluation.get("trained"))

    @property
    def beside(self) -> Sequence[Document]:
        """Errors where only the load or only the motion is new; not judged."""
        return as_objects(self.evaluation.get("beside"))

    @property
    def above(self) -> str:
        """Where the high-frequency part of the signal begins, `12.5 Hz`; empty when unknown."""
        cutoff = self.held_out.get("cutoff_hz")
        if not isinstance(cutoff, list) or not cutoff:
            return ""
        edges = dict.fromkeys(number(as_float(edge)) for edge in cutoff)
        return f"{'–'.join(edges)} Hz"

    @property
    def fast_part(self) -> str:
        """What `noise_floor` is: the part the filter takes away, or the scatter within dwells."""
        if self.above:
            return f"part above {self.above}"
        if "cutoff_hz" in self.held_out:
            return "scatter within dwells"
        return "high-frequency part"

    @property
    def criteria(self) -> Sequence[Document]:
        """Rows of its verdict."""
        return as_objects(as_object(self.evaluation.get("verdict")).get("rows"))

    @property
    def source(self) -> str:
        """Recording it was judged on; empty for the part of a run that was held out."""
        return str(self.held_out.get("source") or "")

    @property
    def unit(self) -> str:
        """Unit of the effort, `A` or `N·m`; empty when unknown."""
        return str(self.held_out.get("unit", ""))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints, in the order of every value."""
        return as_names(self.held_out.get("joint_names"))

    def total(self, part: Part = "held_out") -> Document:
        """The errors over all rows of a part."""
        return as_object((self.held_out if part == "held_out" else self.trained).get("total"))

    def mean(self, metric: str, part: Part = "held_out") -> float:
        """Mean of a metric over the joints it is defined for; NaN when unknown.

        The two means the evaluation stores itself (`rmse_raw`, `rmse_filtered`) are read, not
        computed again.
        """
        stored = as_float(self.total(part).get(f"mean_{metric.removeprefix('rmse_')}"))
        if math.isfinite(stored):
            return stored
        known = self.values(metric, part)
        known = known[np.isfinite(known)]
        return float(known.mean()) if len(known) else float("nan")

    def values(self, metric: str, part: Part = "held_out") -> FloatArray:
        """(n,) a metric per joint; NaN where it is undefined or not stored."""
        values = self.total(part).get(metric)
        if not isinstance(values, list) or len(values) != len(self.joint_names):
            return np.full(len(self.joint_names), np.nan)
        return np.array([as_float(value) for value in values])


def _estimator_of(folder: Path) -> str:
    return folder.name.rpartition("-")[0] or folder.name


def _protocol(model: Document, evaluation: Document) -> str:
    """As the model says, or the evaluation; models of an older hil are honest and say nothing."""
    told = as_object(model.get("fitted")).get("protocol") or evaluation.get("protocol")
    return str(told or HONEST)


def model_folders(run: Path) -> list[Path]:
    """`fit/<estimator>-<digest>` of every model of a run."""
    path = run / "fit"
    return sorted(item for item in path.iterdir() if item.is_dir()) if path.is_dir() else []


def read_fits(folders: Sequence[Path], problems: list[str]) -> tuple[FitFacts, ...]:
    """The models in some folders; one that was judged on several sources appears once for each."""
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
    """The fits that have held-out errors, honest ones first, then smallest raw RMSE first."""

    def rank(fit: FitFacts) -> tuple[bool, bool, float]:
        error = fit.mean("rmse_raw")
        return not fit.is_honest, not math.isfinite(error), error

    return tuple(sorted((fit for fit in fits if fit.held_out), key=rank))
