"""Was a model fitted to a run? Told by its rows, where the name it knows is no run's any more.

Whoever renames a run leaves a model that was fitted to it with a name that leads nowhere. What the
model remembers of its training data (`hil.data.fingerprints`) still finds it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

from hil.core import HilError, RegistryError
from hil.data import Sketch
from hil.estimators import load_model_file
from hil.importers import load_source
from hil.runs.origins import Lost


def why_by_rows(lost: Iterable[Lost]) -> Callable[[Path], str]:
    """A function of a run that says why it has to stay, empty where none of its rows is known.

    Args:
        lost: Versions whose training sources are not found by name.

    Raises:
        RegistryError: (the function) A version cannot be read.
    """
    versions = list(lost)
    sketch = cache(_sketch)

    def why(run: Path) -> str:
        asked = [(one, rows) for one in versions if (rows := sketch(one.model)) is not None]
        if not asked:
            return ""
        try:
            data = load_source(run, any_arm=True)
        except HilError as error:
            return f"it cannot be told whether a model was fitted to it: {error.message}"
        return next((one.why for one, rows in asked if rows.share_known(data) > 0.0), "")

    return why


def _sketch(model: Path) -> Sketch | None:
    """What a model remembers; None of one that remembers nothing.

    Raises:
        RegistryError: It cannot be read.
    """
    try:
        training = load_model_file(model).training_
    except HilError as error:
        raise RegistryError(
            f"{model} does not say what it was fitted to: {error.message}",
            hint="restore the registry from a backup; nothing is deleted before",
        ) from error
    return training.rows if training is not None and len(training.rows.smallest) else None
