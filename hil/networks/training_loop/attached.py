"""What an estimator that trains networks is given before a fit and does not store. No torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hil.core import SpecError
from hil.networks.training_loop.problem import Watch


def keeps_checkpoints(model: Any) -> bool:
    """Whether a fit of the estimator can be taken up again."""
    return hasattr(model, "checkpoints_")


def attach_inside(part: Any, whole: Any, name: str) -> None:
    """Give a part of an estimator its watch, and a folder in its folder, where the part has them.

    Args:
        part: An estimator that is fitted inside another.
        whole: The other, with `watch_` and `checkpoints_`.
        name: Of the folder.
    """
    kept: Path | None = whole.checkpoints_
    inside = kept / name if kept is not None and keeps_checkpoints(part) else None
    attach(part, whole.watch_, inside)


def attach(model: Any, watch: Watch | None = None, checkpoints: Path | None = None) -> None:
    """Set the `watch_` and `checkpoints_` of an estimator that has them.

    Raises:
        SpecError: Checkpoints are asked for, and it trains nothing that could be taken up again.
    """
    if watch is not None and hasattr(model, "watch_"):
        model.watch_ = watch
    if checkpoints is None:
        return
    if not keeps_checkpoints(model):
        raise SpecError(
            f"{model.estimator} keeps no checkpoints: its fit is one computation",
            hint="leave --checkpoints out; networks trained by gradient take it, such as "
            "lagrangian and residual",
        )
    model.checkpoints_ = checkpoints
