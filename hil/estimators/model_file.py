"""A fitted model on disk: `model.json` says what it is, `model.safetensors` holds its arrays.

Never pickle: a model file is read on other machines, years later, from people one does not know.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray, SpecError, json_text
from hil.estimators.base import RobotEstimator, estimator
from hil.estimators.model_folder import MODEL_FILE, only_model
from hil.estimators.robot_file import URDF_FILE, restore_robot, store_robot
from hil.estimators.sound import require_sound, text
from hil.estimators.training import ROWS_ARRAY, Training

MODEL_FORMAT = 1
ARRAYS_FILE = "model.safetensors"


def save_model(model: RobotEstimator, folder: Path) -> Path:
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


def model_files(model: RobotEstimator) -> dict[str, bytes]:
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


def load_model_file(folder: str | Path) -> RobotEstimator:
    """The model a folder holds, ready to predict.

    Args:
        folder: Of the model, or a run with just one.

    Raises:
        DataError: Files are missing or damaged, were written by a newer hil, or the run has
            several models.
        PluginError: The estimator it was made with is not installed.
    """
    folder = only_model(Path(folder))
    document = _read_document(folder / MODEL_FILE)
    arrays = _read_arrays(folder / ARRAYS_FILE, str(document.get("arrays_sha256", "")))
    try:
        model = estimator(text(document["estimator"]), **document["parameters"])
        model.robot_ = restore_robot(document["robot"], folder)
        model.restore(arrays, document["fitted"])
        require_sound(model)
        # Models of an older hil do not say what they were trained on.
        if document.get("training"):
            model.training_ = Training.restored(document["training"], arrays)
    except _GARBLED as error:
        raise DataError(
            f"{folder / MODEL_FILE} lacks or garbles {error}", hint="fit the model again"
        ) from error
    return model


_GARBLED = (
    KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, MemoryError,
    SpecError,
)  # fmt: skip
"""What reading a damaged document may end with; estimators are plug-ins and check little."""


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


def _read_document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror}", hint="see whether you may read it"
        ) from error
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path} is not valid JSON: {error}", hint="copy the model folder again"
        ) from error
    version = document.get("hil_model") if isinstance(document, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise DataError(
            f"{path} does not say which model format it has (hil_model)",
            hint="copy the model folder again, or fit the model again",
        )
    if version > MODEL_FORMAT:
        raise DataError(
            f"{path} was written by a newer hil: format {version}, known here {MODEL_FORMAT}",
            hint="update hil (pip install --upgrade hil)",
        )
    found: dict[str, Any] = document
    return found


def _read_arrays(path: Path, digest: str) -> dict[str, FloatArray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror}", hint="copy the model folder again"
        ) from error
    if hashlib.sha256(content).hexdigest() != digest:
        raise DataError(
            f"{path} does not belong to the {MODEL_FILE} beside it, or is damaged",
            hint="copy the model folder again, or fit the model again",
        )
    try:
        arrays: dict[str, FloatArray] = load(content)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise DataError(
            f"{path} is no safetensors file of numbers: {error!s:.100}", hint="fit the model again"
        ) from error
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu":
            raise DataError(
                f"{path}: {name} holds {values.dtype}, no real numbers", hint="fit the model again"
            )
    return arrays
