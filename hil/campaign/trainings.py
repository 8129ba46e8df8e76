"""Fits of a run while they go on: told to whoever watches, kept until the run is judged.

`RUN/.training/<estimator>-<digest>/` holds the training of networks as far as it is. Whoever is
interrupted goes on from there with `hil resume`; once there is a verdict nobody needs it any more.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.errors import DataError
from hil.fitting import DIGEST_LENGTH, Fitted
from hil.identify.model_file import json_bytes
from hil.spec.experiment import Fit

if TYPE_CHECKING:
    from hil.identify.training_loop.problem import Told

FOLDER = ".training"

EVERY_S = 0.1
"""Epochs are told no more often than this [s]."""

Tell = Callable[[Mapping[str, Any]], None]
"""Told events: `training` at an epoch, `fitted` at the end of a fit."""


def nobody(event: Mapping[str, Any]) -> None:
    """Fits that nobody watches."""


class FitNews:
    """What is told of one of the fits of a run.

    Args:
        estimator: Its name.
        number: From 1.
        total: How many there are.
        tell: Whoever watches.
    """

    def __init__(self, estimator: str, number: int, total: int, tell: Tell) -> None:
        self._which = {"estimator": estimator, "number": number, "total": total}
        self._tell, self._next = tell, 0.0

    def epoch(self, told: Told) -> None:
        """Tell an epoch if it is time to; the first of every network in any case."""
        now = time.monotonic()
        if told.epoch == 1 or now >= self._next:
            self._next = now + EVERY_S
            self._tell({"kind": "training", **self._which, "epoch": asdict(told)})

    @contextmanager
    def ended(self) -> Iterator[None]:
        """Tell how long what is inside took, and whether it failed; nothing of an interrupt."""
        begin = time.perf_counter()
        try:
            yield
        except Exception:
            self._ended(begin, failed=True)
            raise
        self._ended(begin, failed=False)

    def _ended(self, begin: float, *, failed: bool) -> None:
        ending = {"seconds": time.perf_counter() - begin, "failed": failed}
        self._tell({"kind": "fitted", **self._which, **ending})


def fit_or_go_on(run: Path, fit: Fit, make: Callable[[Path], Fitted]) -> Fitted:
    """Make a fit, going on with its training if one was interrupted.

    A training that cannot be gone on with, say one of another version, is begun anew.

    Args:
        run: The run directory.
        fit: The entry of the spec.
        make: Fits, keeping trainings in the folder that it is given.
    """
    folder = _folder(run, fit)
    found = folder.exists()
    try:
        return make(folder)
    except DataError:
        if not found:
            raise
    shutil.rmtree(folder, ignore_errors=True)
    return make(folder)


def forget(run: Path) -> None:
    """Remove what was kept: the run is judged."""
    shutil.rmtree(run / FOLDER, ignore_errors=True)


def are_kept(run: Path) -> bool:
    """Whether a training of the run can be gone on with."""
    return any((run / FOLDER).glob("*/**/checkpoint.json"))


def _folder(run: Path, fit: Fit) -> Path:
    text = json_bytes({"estimator": fit.estimator, "parameters": fit.parameters})
    digest = hashlib.sha256(text).hexdigest()[:DIGEST_LENGTH]
    return run / FOLDER / f"{fit.estimator}-{digest}"
