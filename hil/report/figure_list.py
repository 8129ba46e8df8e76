"""Registry of the figures of runs and models.

To add a figure, write a function in `run_figures` or `model_figures` and register the function as
follows:

    @figure("model") def residual_histogram(view: ModelView) -> Figure | None:
        ...

The registered figure appears on every page under its subject, in the order of registration, and
`hil figures` exports the figure. A registered function returns None if there are no data to draw.

Looks with a meaning are imported from `colours`; the legend shows the names of the curves. Each
registered function reduces its samples with `curves`, because the suitable kind of reduction
depends on the figure.
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
"""Registered functions that create the figures of each subject, in the order of the page."""


def figure(subject: Subject) -> Callable[[Maker], Maker]:
    """Register a function that creates a figure of a subject.

    Args:
        subject: Subject of the figure, which determines the argument of the function: a `RunView`
            for `excitation` and `recording`, a `ModelView` for `model`, and all models of the page
            (`Sequence[FitFacts]`) for `models`.
    """

    def register(make: Maker) -> Maker:
        FIGURES.setdefault(subject, []).append(make)
        return make

    return register


def figures_of(subject: Subject, view: Any) -> list[Figure]:
    """Return all figures of a subject that can be drawn from the view."""
    return [made for make in FIGURES[subject] if (made := make(view)) is not None]
