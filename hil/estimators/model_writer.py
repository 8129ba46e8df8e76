"""Writing a fitted model: `model.json` says what it is, `model.safetensors` holds its arrays."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.core import FitError, FloatArray, json_text
from hil.dynamics import RobotModel
from hil.estimators.model_folder import MODEL_FILE
from hil.estimators.robot_file import URDF_FILE, store_robot
from hil.estimators.training import ROWS_ARRAY, Training

MODEL_FORMAT = 1
ARRAYS_FILE = "model.safetensors"


class Savable(Protocol):
    """What a fitted model offers for its file; every `RobotEstimator` does."""

    @property
    def estimator(self) -> str:
        """Name of the estimator."""

    @property
    def robot_(self) -> RobotModel:
        """Robot that the model is of."""

    @property
    def training_(self) -> Training | None:
        """What it was trained on, if known."""

    def get_params(self) -> dict[str, Any]:
        """Return the parameters of the estimator."""

    def fitted_arrays(self) -> Mapping[str, FloatArray]:
        """Return all numbers that were fitted."""

    def fitted_facts(self) -> dict[str, Any]:
        """Return names and units of what was fitted."""


def save_model(model: Savable, folder: Path) -> Path:
    """Write a fitted model into `folder`, `model.json` last; returns the folder.

    Raises:
        FitError: The model is not fitted, its robot cannot be stored, or the folder holds a model
            already.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit before save")
    if (folder / MODEL_FILE).exists():
        raise FitError(
            f"{folder} holds a model already, and models are never overwritten",
            hint="save into a new folder",
        )
    files = model_files(model)
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_whole(folder / name, content)
    return folder


def model_files(model: Savable) -> dict[str, bytes]:
    """The files of a model folder by name, `model.json` last; equal models give equal bytes."""
    from safetensors.numpy import save

    fitted: dict[str, Any] = dict(model.fitted_arrays())
    if model.training_ is not None:
        fitted[ROWS_ARRAY] = model.training_.rows.smallest
    arrays = save({name: np.ascontiguousarray(values) for name, values in fitted.items()})
    robot, urdf = store_robot(model.robot_)
    document = {
        "hil_model": MODEL_FORMAT,
        "estimator": model.estimator,
        "parameters": model.get_params(),
        "robot": robot,
        "fitted": model.fitted_facts(),
        "training": model.training_ and model.training_.facts(),
        "arrays_sha256": hashlib.sha256(arrays).hexdigest(),
    }
    files = {ARRAYS_FILE: arrays} | ({URDF_FILE: urdf} if urdf is not None else {})
    return files | {MODEL_FILE: json_bytes(document)}


def json_bytes(document: Mapping[str, Any]) -> bytes:
    """Strict, indented JSON; NaN and infinity become null, settings become their values."""
    return json_text(plain(document), indent=2, allow_nan=False).encode() + b"\n"


def plain(value: Any) -> Any:
    """A value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return plain(value.model_dump()) if hasattr(value, "model_dump") else value


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is either whole or not there after a crash."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        with draft.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
