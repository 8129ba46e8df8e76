"""Which model is meant by a path: the folder itself, or the only one in a run.

Apart from `hil.estimators.model_file`, because lists of runs and the dashboard ask for folders of
models without ever reading one, and must not load a robot model for it.
"""

from __future__ import annotations

from pathlib import Path

from hil.core import DataError

MODEL_FILE = "model.json"


def models_below(folder: Path) -> list[Path]:
    """Folders of models in a folder, and in `fit` where it is a run, by name."""
    files = (file for under in ("*", "fit/*") for file in folder.glob(f"{under}/{MODEL_FILE}"))
    return sorted(file.parent for file in files)


EXAMPLE = "name a folder such as RUN/fit/rigid-hysteresis-… or models/rigid-hysteresis-…"


def only_model(path: Path) -> Path:
    """The folder of the model at a path, or of the only one below it.

    Raises:
        DataError: There is none, or there are several, which are listed.
    """
    if (path / MODEL_FILE).is_file():
        return path
    below = models_below(path) if path.is_dir() else []
    if len(below) == 1:
        return below[0]
    if below:
        raise DataError(
            f"{path} holds {len(below)} models: {', '.join(map(str, below))}", hint="give one"
        )
    raise DataError(f"{path} {_lack(path)}", hint=_where(path))


def _lack(path: Path) -> str:
    if not path.exists():
        return "is no model folder: it does not exist"
    if not path.is_dir():
        return "is a file, no model folder"
    if (path / "start.json").is_file():
        return "is a run without a model"
    return f"is no model folder: there is no {MODEL_FILE} in it"


def _where(path: Path) -> str:
    if (path / "start.json").is_file():
        return f"fit one: hil fit {path} --estimator NAME"
    if path.is_file() and (path.parent / MODEL_FILE).is_file():
        return f"give the folder it lies in: {path.parent}"
    return EXAMPLE
