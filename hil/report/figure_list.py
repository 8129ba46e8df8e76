"""The list of figures of runs and models.

To add one, write one function in `run_figures` or `model_figures` and register it:

    @figure("model")
    def residual_histogram(view: ModelView) -> Figure | None:
        ...

It then stands on every page in the place of its subject, in the order of its file, and is among
the files that `hil figures` writes. A function returns None where it has nothing to show.

Looks that have a meaning come from `colours`; names of curves are what the legend says. Samples are
thinned by the functions (`curves`), which know what of them matters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import numpy as np

from hil.studies import Figure

DEGREES = 180 / np.pi

Subject: TypeAlias = Literal["excitation", "recording", "models", "model"]
Maker: TypeAlias = Callable[[Any], Figure | None]

FIGURES: dict[Subject, list[Maker]] = {}
"""The figures of each subject, in the order of the page."""


def figure(subject: Subject) -> Callable[[Maker], Maker]:
    """Register a function that makes a figure.

    Args:
        subject: `excitation` and `recording` are given a `RunView`, `model` a `ModelView`,
            and `models` all models of the page (`Sequence[FitFacts]`).
    """

    def register(make: Maker) -> Maker:
        FIGURES.setdefault(subject, []).append(make)
        return make

    return register


def figures_of(subject: Subject, view: Any) -> list[Figure]:
    """Return all figures of a subject that have something to show."""
    return [made for make in FIGURES[subject] if (made := make(view)) is not None]
