"""A fitted model on disk: a folder that can be read on other machines, years later.

`model.json` says what the model is: estimator and parameters, the robot, names and units of what
was fitted, and a digest of the arrays. `model.safetensors` holds the arrays, `robot.urdf` a copy of
the URDF if the robot has one. Never pickle: models come from people one does not know. `model.json`
is written last, so that a folder with one is whole; models are never overwritten, and equal models
give equal bytes.

This module knows files but no estimators: it writes what a model tells of itself (`save_model`) and
reads documents, arrays and robots back, and refuses what is damaged, newer than this hil, or of an
arm whose description has changed. `hil.estimators.base.load_model_file` makes a model of them;
which folder a path means is for `hil.estimators.model_folder` to say.
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
"""Array that holds the fingerprints of the training data."""

Array = TypeVar("Array")


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
    return files | {MODEL_FILE: json_document(document)}


def read_document(path: Path) -> dict[str, Any]:
    """What `model.json` says.

    Raises:
        DataError: It cannot be read, is damaged, or was written by a newer hil.
    """
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
    return dict(document)


def read_arrays(path: Path, digest: str) -> dict[str, FloatArray]:
    """The arrays of a model.

    Raises:
        DataError: They cannot be read, are not those that `model.json` belongs to, or no numbers.
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
            f"{path} is no safetensors file of numbers: {error!s:.100}", hint="fit the model again"
        ) from error
    for name, values in arrays.items():
        if values.dtype.kind not in "fiu":
            raise DataError(
                f"{path}: {name} holds {values.dtype}, no real numbers", hint="fit the model again"
            )
    return arrays


def store_robot(robot: RobotModel) -> tuple[dict[str, Any], bytes | None]:
    """What `model.json` says about the robot, and the URDF to be stored beside it.

    Raises:
        FitError: The URDF is gone, or the robot is not what its description leads to (the file
            was changed since, say), so the stored model would predict something else.
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
            f"the robot model differs from what {robot.name} leads to when it is loaded again, so "
            "the fitted model cannot be stored",
            hint="load the robot from its file again and fit again",
        )


def restore_robot(document: dict[str, Any], folder: Path) -> RobotModel:
    """The robot model a folder was stored with: mounting, rotor inertias and loads included.

    Raises:
        DataError: Its built-in arm or URDF cannot be used here, or the file that describes its arm
            was changed since.
        KeyError, TypeError, ValueError: The document is damaged.
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
    """Enough to recognise the training data and to scale errors as they were scaled then.

    Attributes:
        sources: Names of the files or run directories, without their folders.
        samples: Rows.
        effort_std: (n,) standard deviation of the effort, the scale for NRMSE.
        rows: Fingerprints of the samples.
        serial: Serial number of the robot; empty if unknown.
        payloads: The loads declared; None in older model files.
    """

    sources: tuple[str, ...]
    samples: int
    effort_std: FloatArray
    rows: Sketch
    serial: str = ""
    payloads: tuple[Payload, ...] | None = None

    @staticmethod
    def of(dataset: Dataset) -> Training:
        """What there is to remember of a dataset."""
        paths = dict.fromkeys(condition.source for condition in dataset.conditions)
        names = tuple(Path(path).name for path in paths if path)
        std = np.asarray(np.std(dataset["effort"], axis=0))
        loads = tuple(dict.fromkeys(condition.payload for condition in dataset.conditions))
        rows = Sketch.of(dataset)
        return Training(names, len(dataset), std, rows, payloads=loads)

    def facts(self) -> dict[str, Any]:
        """For `model.json`; the fingerprints go into its arrays."""
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
        """Inverse of `facts`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or garbled.
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
    """The arrays under longer names."""
    return {prefix + name: values for name, values in arrays.items()}


def without_prefix(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Those arrays whose names begin with the prefix, by the rest of their names."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
