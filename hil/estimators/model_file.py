"""A fitted model on disk: `model.json` says what it is, `model.safetensors` holds its arrays.

Never pickle: a model file is read on other machines, years later, from people one does not know.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from hil.core import DataError, FloatArray, SpecError
from hil.estimators.base import RobotEstimator, estimator
from hil.estimators.model_folder import MODEL_FILE, only_model
from hil.estimators.model_writer import ARRAYS_FILE, MODEL_FORMAT
from hil.estimators.robot_file import restore_robot
from hil.estimators.sound import require_sound, text
from hil.estimators.training import Training


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
