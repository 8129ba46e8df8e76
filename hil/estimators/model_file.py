"""Storage of a fitted model in a folder that other machines can read years later.

A model folder contains three files. `model.json` describes the model: estimator, parameters, robot,
names and units of the fitted quantities, and a digest of the arrays. `model.safetensors` contains
the fitted arrays. `robot.urdf` is a copy of the URDF if the robot was loaded from a URDF. Pickle is
never used, because model files can come from unknown sources. The file `model.json` is written
last, so a folder that contains this file is complete. Stored models are never overwritten, and
equal models are stored as equal bytes.

The module `model_file` does not depend on any estimator. `save_model` writes the description that a
fitted model returns about itself. The read functions return documents, arrays and robots, and
reject files that are damaged, written by a newer version of hil, or made for an arm whose
description has changed. `hil.estimators.base.load_model_file` creates the model from document,
arrays and robot, and `hil.estimators.model_folder` finds the model folder of a path.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from hil.arms import Payload, require_same_arm
from hil.core import DataError, FitError, FloatArray, SpecError, json_document, write_whole
from hil.data import Dataset, Sketch
from hil.dynamics import MOTOR_SIDE, RobotModel
from hil.estimators.model_folder import MODEL_FILE

MODEL_FORMAT = 1
ARRAYS_FILE, URDF_FILE = "model.safetensors", "robot.urdf"

ROWS_ARRAY = "training_rows"
"""Name of the array that contains the fingerprints of the training data."""

Array = TypeVar("Array")


class Savable(Protocol):
    """Interface of a fitted model that can be stored; every `RobotEstimator` implements it."""

    @property
    def estimator(self) -> str:
        """Name of the estimator that was fitted."""

    @property
    def robot_(self) -> RobotModel:
        """Robot model to which the estimator was fitted."""

    @property
    def training_(self) -> Training | None:
        """Summary of the training data, if known."""

    def get_params(self) -> dict[str, Any]:
        """Return the parameters of the estimator by name."""

    def fitted_arrays(self) -> Mapping[str, FloatArray]:
        """Return all fitted arrays by name."""

    def fitted_facts(self) -> dict[str, Any]:
        """Return the names and units of the fitted quantities, as values that JSON can store."""


def save_model(model: Savable, folder: Path) -> Path:
    """Write a fitted model into `folder` and return the folder; `model.json` is written last.

    Raises:
        FitError: The model is not fitted, its robot cannot be stored, or the folder already
            contains a model.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit before save")
    if (folder / MODEL_FILE).exists():
        raise FitError(
            f"{folder} already contains a model, and models are never overwritten",
            hint="save into a new folder",
        )
    files = model_files(model)
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_whole(folder / name, content)
    return folder


def model_files(model: Savable) -> dict[str, bytes]:
    """Return the contents of a model folder by file name; `model.json` is the last entry.

    Equal models are stored as equal bytes.
    """
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
    return files | {MODEL_FILE: json_document(document)}


def read_document(path: Path) -> dict[str, Any]:
    """Return the parsed content of `model.json`.

    Raises:
        DataError: The file cannot be read, is damaged, or was written by a newer version of hil.
    """
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror}", hint="check the permissions of the file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"{path} is not valid JSON: {error}", hint="copy the model folder again"
        ) from error
    version = document.get("hil_model") if isinstance(document, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise DataError(
            f"{path} does not state its model format (hil_model)",
            hint="copy the model folder again, or fit the model again",
        )
    if version > MODEL_FORMAT:
        raise DataError(
            f"{path} was written by a newer hil: format {version}, this version reads up to "
            f"{MODEL_FORMAT}",
            hint="update hil (pip install --upgrade hil)",
        )
    return dict(document)


def read_arrays(path: Path, digest: str) -> dict[str, FloatArray]:
    """Return the arrays of a model file by name.

    Raises:
        DataError: The file cannot be read, its digest differs from the digest in `model.json`, or
            an array is not numeric.
    """
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
            f"{path} is not a safetensors file of numbers: {error!s:.100}",
            hint="fit the model again",
        ) from error
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu":
            raise DataError(
                f"{path}: {name} has the type {values.dtype}, not real numbers",
                hint="fit the model again",
            )
    return arrays


def store_robot(robot: RobotModel) -> tuple[dict[str, Any], bytes | None]:
    """Return the robot entry of `model.json` and the URDF content; None for a model without URDF.

    Raises:
        FitError: The URDF cannot be read, or its description now yields a different robot, for
            example because the file changed. A model stored with a different robot would predict
            different efforts.
    """
    document = robot.to_dict()
    content = None
    if document["kind"] == "urdf":
        try:
            content = Path(robot.name).read_bytes()
        except OSError as error:
            raise FitError(f"cannot store the robot's URDF: {error}") from error
    _require_same(robot, document)
    if robot.arm is not None and robot.arm.sha256:
        document["model_sha256"] = robot.arm.sha256
    return document, content


def _require_same(robot: RobotModel, document: dict[str, Any]) -> None:
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, robot.n))
    again = RobotModel.from_dict(document)
    pairs = [
        (robot.gravity_regressor(q), again.gravity_regressor(q)),
        (robot.parameters(), again.parameters()),
    ]
    if any(ours.shape != theirs.shape or not np.allclose(ours, theirs) for ours, theirs in pairs):
        raise FitError(
            f"loading {robot.name} again gives a different robot model, so the fitted model "
            "cannot be stored",
            hint="load the robot model from its file, then fit again",
        )


def restore_robot(document: dict[str, Any], folder: Path) -> RobotModel:
    """Return the robot model stored in a model folder, with mounting, rotor inertias and payloads.

    Raises:
        DataError: The built-in arm or URDF cannot be used on this machine, or the file that
            describes the arm has changed since the model was stored.
        KeyError, TypeError, ValueError: The content of the document is damaged.
    """
    if document["kind"] == "urdf":
        document = document | {"name": str(folder / URDF_FILE)}
    else:
        own = {**document, "model": str(document["name"]).removesuffix(MOTOR_SIDE)}
        require_same_arm(own, folder, "fit the model again")
    try:
        return RobotModel.from_dict(document)
    except SpecError as error:
        raise DataError(f"{folder}: {error.message}", hint=error.hint) from error


@dataclass(frozen=True, slots=True, eq=False)
class Training:
    """Summary of the training data, used to detect reuse of samples and to scale errors.

    Attributes:
        sources: Names of the files or run directories, without their folders.
        samples: Number of rows of the training data.
        effort_std: (n,) standard deviation of the effort, which is the scale of the NRMSE.
        rows: Fingerprints of the training samples.
        serial: Serial number of the robot; empty if unknown.
        payloads: Declared payloads of the training data; None for older model files.
    """

    sources: tuple[str, ...]
    samples: int
    effort_std: FloatArray
    rows: Sketch
    serial: str = ""
    payloads: tuple[Payload, ...] | None = None

    @staticmethod
    def of(dataset: Dataset) -> Training:
        """Return the training summary of a dataset."""
        paths = dict.fromkeys(condition.source for condition in dataset.conditions)
        names = tuple(Path(path).name for path in paths if path)
        std = np.asarray(np.std(dataset["effort"], axis=0))
        loads = tuple(dict.fromkeys(condition.payload for condition in dataset.conditions))
        rows = Sketch.of(dataset)
        return Training(names, len(dataset), std, rows, payloads=loads)

    def facts(self) -> dict[str, Any]:
        """Return the training summary as entries for `model.json`.

        The fingerprints are not included, because they are stored as an array.
        """
        return {
            "sources": list(self.sources),
            "samples": self.samples,
            "serial": self.serial,
            "payloads": self.payloads
            and [[load.mass, *load.com, *load.inertia] for load in self.payloads],
            "effort_std": self.effort_std,
            "every_row_kept": self.rows.complete,
        }

    @staticmethod
    def restored(facts: Mapping[str, Any], arrays: Mapping[str, Any]) -> Training:
        """Return the summary from the output of `facts` and from the arrays of the model file.

        Raises:
            KeyError, TypeError, ValueError: An entry of the document is missing or invalid.
        """
        loads = facts.get("payloads")
        return Training(
            tuple(facts["sources"]),
            int(facts["samples"]),
            np.array(facts["effort_std"], dtype=np.float64),
            Sketch(np.asarray(arrays[ROWS_ARRAY]), bool(facts["every_row_kept"])),
            str(facts["serial"]),
            None if loads is None else tuple(_load(numbers) for numbers in loads),
        )


def _load(numbers: Sequence[float]) -> Payload:
    mass, x, y, z, *inertia = (float(number) for number in numbers)
    xx, yy, zz, xy, xz, yz = inertia
    return Payload(mass, (x, y, z), (xx, yy, zz, xy, xz, yz))


def with_prefix(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays with a prefix added to their names."""
    return {prefix + name: values for name, values in arrays.items()}


def without_prefix(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays whose names begin with the prefix, and remove the prefix."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
