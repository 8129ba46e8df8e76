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

from hil.core import CheckpointRefused, HilError, Throttle
from hil.estimators import json_bytes
from hil.evaluation import DIGEST_LENGTH, Fitted
from hil.spec import Fit

if TYPE_CHECKING:
    from hil.networks import Told

FOLDER = ".training"

EVERY_S = 0.1
"""Epochs are told no more often than this [s]."""

Tell = Callable[[Mapping[str, Any]], None]
"""Told events: `training` at an epoch, `fit_note`, `fitted` at the end of a fit."""


def nobody(event: Mapping[str, Any]) -> None:
    """Fits that nobody watches."""


class FitNews:
    """What is told of one of the fits of a run; the watch of its trainings.

    Args:
        estimator: Its name.
        number: From 1.
        total: How many there are.
        tell: Whoever watches.
    """

    def __init__(self, estimator: str, number: int, total: int, tell: Tell) -> None:
        self._which = {"estimator": estimator, "number": number, "total": total}
        self._tell, self._often, self._unkept = tell, Throttle(EVERY_S), False

    def __call__(self, told: Told) -> None:
        """Tell an epoch if it is time to; the first of every network in any case."""
        if self._often.due(anyway=told.epoch == 1):
            self._tell({"kind": "training", **self._which, "epoch": asdict(told)})

    def not_kept(self, error: HilError) -> None:
        """Tell once that the disk does not take the trainings; the fit goes on."""
        if not self._unkept:
            self.note(f"{error.message}; the fit goes on without")
        self._unkept = True

    def note(self, text: str) -> None:
        """Tell something that a person should know of the fit."""
        self._tell({"kind": "fit_note", **self._which, "text": text})

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


def fit_or_go_on(
    run: Path, fit: Fit, make: Callable[[Path], Fitted], note: Callable[[str], None]
) -> Fitted:
    """Make a fit, going on with its trainings if it was interrupted.

    A training that cannot be gone on with, say one of another version, is removed and begun anew;
    others of the same fit stay.

    Args:
        run: The run directory.
        fit: The entry of the spec.
        make: Fits, keeping trainings in the folder that it is given.
        note: Told what is begun anew, and why.
    """
    folder = _folder(run, fit)
    removed: set[Path] = set()
    while True:
        try:
            return make(folder)
        except CheckpointRefused as error:
            refused = error.folder
            if refused is None or refused in removed or not refused.is_relative_to(folder):
                raise
            removed.add(refused)
            note(f"{error.message}; this training begins anew")
            shutil.rmtree(refused, ignore_errors=True)


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
