"""A fitted model as one JSON document: parameters with units and how sure they are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hil.core import FitError
from hil.estimators import RobotEstimator, json_bytes
from hil.export.exported import Exported, require_new, write_file
from hil.export.json_check import checked
from hil.export.json_entries import conditions_of
from hil.export.json_friction import friction_part, networks_part
from hil.export.json_parameters import parameters_of
from hil.export.json_robot import effort_part, links_part, model_part, robot_part, sigma_part
from hil.networks import CorrectedModel

FORMAT = 1
"""Grows when a reader of older documents would misread a new one."""


def export_json(model: RobotEstimator, out: Path) -> Exported:
    """Write the parameters of a model, after its torques were computed from them.

    Args:
        model: Fitted.
        out: File to be made.

    Raises:
        FitError: The model is not fitted, or what the document says is not what the model says.
        RecordingError: The file exists already, or cannot be made.
    """
    require_new(out)
    document = document_of(model)
    write_file(json_bytes(document), out)
    joints, unit = model.joint_names_, document["effort"]["unit"]
    count = len(document["parameters"])
    told = sum(one["std"] is not None for one in document["parameters"])
    parts = f"{model.estimator}, {count} parameters, {told} with standard errors"
    return Exported(out, (out.name,), joints, unit, parts, document["checked"], model.notes_)


def document_of(model: RobotEstimator) -> dict[str, Any]:
    """The document of a fitted model, as it is read back.

    Raises:
        FitError: As `export_json`.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    physics = model.base_ if isinstance(model, CorrectedModel) else model
    parts = {
        "hil_export": FORMAT,
        "model": model_part(model),
        "robot": robot_part(model.robot_),
        "effort": effort_part(model),
        "sigma": sigma_part(model),
        "std_errors": conditions_of(physics),
        "parameters": parameters_of(model),
        "friction": friction_part(model),
        "links": links_part(model),
        "networks": networks_part(model),
    }
    document: dict[str, Any] = json.loads(json_bytes(parts))
    return document | {"checked": checked(model, document)}
