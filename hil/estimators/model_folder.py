"""Search for the model folder of a path: the path itself, or the only model of a run.

The functions of this module are separate from `hil.estimators.model_file`, because run lists and
the dashboard only need the folders of models and must not load a robot model.
"""

from __future__ import annotations

from pathlib import Path

from hil.core import DataError

MODEL_FILE = "model.json"


def models_below(folder: Path) -> list[Path]:
    """Return the model folders inside a folder and inside its `fit` subfolder, sorted by path."""
    files = (file for under in ("*", "fit/*") for file in folder.glob(f"{under}/{MODEL_FILE}"))
    return sorted(file.parent for file in files)


EXAMPLE = "name a folder such as RUN/fit/rigid-hysteresis-… or models/rigid-hysteresis-…"


def only_model(path: Path) -> Path:
    """Return the model folder at a path, or the only model folder in the run below it.

    Raises:
        DataError: The path contains no model or several models; if there are several, the message
            lists the models.
    """
    if (path / MODEL_FILE).is_file():
        return path
    below = models_below(path) if path.is_dir() else []
    if len(below) == 1:
        return below[0]
    if below:
        raise DataError(
            f"{path} contains {len(below)} models: {', '.join(map(str, below))}", hint="give one"
        )
    raise DataError(f"{path} {_fault(path)}", hint=_remedy(path))


def _fault(path: Path) -> str:
    if not path.exists():
        return "is not a model folder: it does not exist"
    if not path.is_dir():
        return "is a file, not a model folder"
    if (path / "start.json").is_file():
        return "is a run without a model"
    return f"is not a model folder: it contains no {MODEL_FILE}"


def _remedy(path: Path) -> str:
    if (path / "start.json").is_file():
        return f"fit one: hil fit {path} --estimator NAME"
    if path.is_file() and (path.parent / MODEL_FILE).is_file():
        return f"pass the folder of this file: {path.parent}"
    return EXAMPLE
