"""Export of a fitted model as one JSON document: parameters with units and uncertainties.

A document contains the robot, the predicted effort, every number of the estimator that has a
physical meaning (`json_parameters`), the friction law to which the numbers belong
(`json_friction`), and the size of networks. An unknown value is null; a separate field contains the
reason. Before a document is written, `hil.export.json_check` computes the torques of the model from
the document. Users of a document compute the torques with `hil.export.json_reader`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FitError, json_document
from hil.dynamics import RobotModel, about_centre
from hil.estimators import (
    MODEL_FILE,
    RigidHysteresis,
    RobotEstimator,
    StaticHysteresis,
    model_files,
)
from hil.export.exported import Exported, effort_unit, require_new, write_file
from hil.export.json_check import checked
from hil.export.json_friction import friction_part
from hil.export.json_parameters import conditions_of, parameters_of, torque_unit
from hil.export.program import flange_in_last_joint
from hil.networks import LagrangianEstimator, ResidualNetwork, StaticMlpLm

FORMAT = 1
"""Format version, which increases if older readers would misinterpret new documents."""


def export_json(model: RobotEstimator, out: Path) -> Exported:
    """Write the parameters of a model, after computing the model's torques from the document.

    Args:
        model: Fitted model.
        out: File that is created.

    Raises:
        FitError: The model is not fitted, or the document does not reproduce the predictions of the
            model.
        RecordingError: The file already exists, or cannot be created.
    """
    require_new(out)
    document = document_of(model)
    write_file(json_document(document), out)
    joints, unit = model.joint_names_, document["effort"]["unit"]
    count = len(document["parameters"])
    told = sum(one["std"] is not None for one in document["parameters"])
    parts = f"{model.estimator}, {count} parameters, {told} with standard errors"
    return Exported(out, (out.name,), joints, unit, parts, document["checked"], model.notes_)


def document_of(model: RobotEstimator) -> dict[str, Any]:
    """Return the document of a fitted model, after reading the document back from JSON.

    Raises:
        FitError: The model is not fitted, or the document does not reproduce the predictions of the
            model.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    physics = model.base_ if isinstance(model, ResidualNetwork) else model
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
    document: dict[str, Any] = json.loads(json_document(parts))
    return document | {"checked": checked(model, document)}


def model_part(model: RobotEstimator) -> dict[str, Any]:
    """Return estimator, settings and training data of the model, as `model.json` contains them."""
    stored = json.loads(model_files(model)[MODEL_FILE])
    filters = getattr(model, "filters_", None) or getattr(model, "filters", None)
    return {
        "estimator": model.estimator,
        "protocol": model.protocol,
        "settings": stored["parameters"],
        "filters": filters,
        "samples": model.samples_,
        "condition": getattr(model, "condition_", None),
        "training": stored["training"],
        "fingerprint_sha256": stored["arrays_sha256"],
        "physics": model.base_.estimator if isinstance(model, ResidualNetwork) else None,
        "notes": list(model.notes_),
    }


def robot_part(robot: RobotModel) -> dict[str, Any]:
    """Return the joints with their placements, which replace any other description of the arm."""
    geometry, described = robot.joint_geometry(), robot.to_dict()
    coupling = getattr(robot, "joints_per_motor", None)
    joints = [
        {
            "name": name,
            "type": "revolute" if geometry.turns[j] else "prismatic",
            "placement": geometry.placement[j],
            "axis": geometry.axis[j],
            "position_min": robot.q_min[j],
            "position_max": robot.q_max[j],
            "speed_max": robot.qd_max[j],
            "torque_max": robot.effort_max[j],
        }
        for j, name in enumerate(robot.joint_names)
    ]
    return {
        # Only the file name: the folder is private and does not identify the robot.
        "name": Path(robot.name).name,
        "gravity_m_s2": robot.gravity_vector,
        "joints": joints,
        "joints_per_motor": coupling,
        "flange": {"name": described["flange"], "placement": flange_in_last_joint(robot)},
    }


GAINS_UNKNOWN = (
    "the model stores the source of its gains, not their uncertainty; see hil drive-gains"
)

NO_GAINS = (
    "fitted to currents without drive gains: values that are otherwise in N·m are in A, 1 A per A"
)
A_TORQUE = "efforts are torques"


def effort_part(model: RobotEstimator) -> dict[str, Any]:
    """Return kind and unit of the predicted effort, and the torque of one unit of effort."""
    unit, torque = effort_unit(model.effort_kind_), torque_unit(model)
    known = not (torque == "A" and unit == "A")
    reason = (GAINS_UNKNOWN if known else NO_GAINS) if unit == "A" else A_TORQUE
    return {
        "kind": model.effort_kind_,
        "unit": unit,
        "torque_per_effort": {
            "values": model.torque_scale_ if known else None,
            "unit": f"{torque}/{unit}" if unit == "A" else "1",
            "source": model.gains_source_ or None,
            "std": None,
            "reason": reason,
        },
    }


def sigma_part(model: RobotEstimator) -> dict[str, Any]:
    """Return the prediction error of each joint."""
    bands = getattr(model, "bands_", None)
    return {
        "values": model.sigma_,
        "unit": effort_unit(model.effort_kind_),
        "meaning": _sigma_meaning(model),
        "bands": bands
        and {
            "asked": bands.asked,
            "speed_edges_rad_s": bands.edges,
            "half_widths": bands.half_widths,
            "guaranteed": bands.guaranteed,
        },
    }


def _sigma_meaning(model: RobotEstimator) -> str:
    if isinstance(model, RigidHysteresis | ResidualNetwork | LagrangianEstimator):
        return "root mean square error on trajectories that were left out of the fit"
    if isinstance(model, StaticMlpLm):
        return "root mean square error at poses held out of the training, if there were any"
    if isinstance(model, StaticHysteresis) and len(model.penalty_):
        return "root mean square error on poses that were not used to fit the correction"
    return "standard deviation of the training residual"


NO_LINKS = "the estimator identifies only sums of inertial parameters, not those of single links"

CHOICE = (
    "one of many physically consistent sets of links with these torques: the mass of a single "
    "link is a choice, only the base parameters were measured"
)


def links_part(model: RobotEstimator) -> dict[str, Any]:
    """Return the inertial parameters of physically consistent links, if the model has them."""
    physics = getattr(model, "base_", model)
    inertial = getattr(physics, "inertial_", None)
    if inertial is None:
        return {"values": None, "reason": NO_LINKS, "note": None}
    n, names = physics.robot_.n, physics.joint_names_
    rows = zip(names, inertial[: 10 * n].reshape(n, 10), inertial[10 * n :], strict=True)
    return {"values": [_link(*row) for row in rows], "reason": None, "note": CHOICE}


def _link(joint: str, body: np.ndarray[Any, Any], rotor: float) -> dict[str, Any]:
    mass, com, inertia = about_centre(body)
    return {
        "joint": joint,
        "mass_kg": mass,
        "com_m": com,
        "inertia_kgm2": inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        "rotor_inertia_kgm2": rotor,
    }


def networks_part(model: RobotEstimator) -> list[dict[str, Any]]:
    """Return sizes and storage locations of the networks, whose weights are not in the document."""
    if isinstance(model, ResidualNetwork):
        return [_residual(model), *networks_part(model.base_)]
    if isinstance(model, LagrangianEstimator):
        weights = sum(int(w.size) for w in model.weights_.values() if w.dtype.kind == "f")
        what = "inertia matrix and potential of the arm, and friction if it is a network"
        inputs = ["q", "qd", "qdd", "direction"]
        return [_network(what, 1, weights, "network.", inputs, model.design_.facts(), model)]
    if isinstance(model, StaticMlpLm):
        mlp = model.networks_.mlp
        layout = {"layers": list(mlp.layers), "activations": list(mlp.activations)}
        n, weights = len(model.joint_names_), int(model.networks_.weights.size)
        what = "friction at rest, one network per joint"
        return [_network(what, n, weights, "network.", list(model.inputs), layout, model)]
    if isinstance(model, StaticHysteresis) and len(model.penalty_):
        arrays = model.fitted_arrays()
        weights = int(np.size(arrays["correction_weights"]))
        what = "linear correction of friction by the path into the pose, one per joint"
        inputs = ["path", "load", "temperature"]
        layout = {"penalty": model.penalty_}
        return [_network(what, len(model.penalty_), weights, "correction_", inputs, layout, model)]
    return []


def _residual(model: ResidualNetwork) -> dict[str, Any]:
    correction = model.correction_
    first = correction.networks[0]
    weights = sum(
        int(np.size(values)) for one in correction.networks
        for values in one.weights.to_arrays().values()
    )  # fmt: skip
    inputs = ["q", "qd", "qdd"] + (
        [] if correction.settings.inputs == "motion" else ["measured torque"]
    )
    layout = correction.settings.to_json() | {
        "rate_hz": first.rate_hz,
        "window_samples": correction.settings.window,
    }
    what = "residual of the physics in motion, in effort units: mean of the networks"
    told = _network(what, len(correction.networks), weights, "network", inputs, layout, model)
    kept = zip(model.joint_names_, correction.kept, strict=True)
    return told | {"joints": [name for name, own in kept if own], "limit": correction.limit}


STORED = "model.safetensors"


def _network(
    what: str, count: int, weights: int, arrays: str, inputs: list[str], layout: dict[str, Any],
    model: RobotEstimator,
) -> dict[str, Any]:  # fmt: skip
    return {
        "what": what,
        "count": count,
        "weights": weights,
        "stored_in": STORED,
        "arrays": f"{arrays}*",
        "inputs": inputs,
        "layout": layout,
        "joints": list(model.joint_names_),
        "limit": None,
    }
