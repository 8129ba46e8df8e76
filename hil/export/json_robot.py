"""Parts of a JSON document that say which model of which robot it is, and in what units."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hil.dynamics import RobotModel, about_centre
from hil.estimators import (
    MODEL_FILE,
    RigidHysteresis,
    RobotEstimator,
    StaticHysteresis,
    model_files,
)
from hil.export.exported import effort_unit
from hil.export.json_parameters import torque_unit
from hil.export.reading import flange_in_last_joint
from hil.networks import CorrectedModel, LagrangianModel, StaticMlpLm

CHOICE = (
    "one set of links that can exist and has these torques: a single link's mass is a choice among "
    "many, only the base parameters were measured"
)
NO_LINKS = "the estimator knows sums of inertial parameters only, not those of single links"

GAINS_UNKNOWN = (
    "the model knows where its gains come from, not how sure they are; hil gains tells that"
)
NO_GAINS = "fitted to currents without drive gains: what others have in N·m is told in A, 1 A per A"
A_TORQUE = "efforts are torques"


def model_part(model: RobotEstimator) -> dict[str, Any]:
    """What found the parameters, with what settings and from what, as `model.json` says it."""
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
        "physics": model.base_.estimator if isinstance(model, CorrectedModel) else None,
        "notes": list(model.notes_),
    }


def robot_part(robot: RobotModel) -> dict[str, Any]:
    """Joints as placements, so that a reader needs no other description of the arm."""
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
        # A path says where somebody keeps files, not what robot it is.
        "name": Path(robot.name).name,
        "gravity_m_s2": robot.gravity_vector,
        "joints": joints,
        "joints_per_motor": coupling,
        "flange": {"name": described["flange"], "placement": flange_in_last_joint(robot)},
    }


def effort_part(model: RobotEstimator) -> dict[str, Any]:
    """Kind and unit of what the model predicts, and the torque that one unit of it is."""
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
    """How far predictions are off, joint by joint."""
    bands = getattr(model, "bands_", None)
    return {
        "values": model.sigma_,
        "unit": effort_unit(model.effort_kind_),
        "meaning": _sigma_of(model),
        "bands": bands
        and {
            "asked": bands.asked,
            "speed_edges_rad_s": bands.edges,
            "half_widths": bands.half_widths,
            "guaranteed": bands.guaranteed,
        },
    }


def _sigma_of(model: RobotEstimator) -> str:
    if isinstance(model, RigidHysteresis | CorrectedModel | LagrangianModel):
        return "root mean square error on trajectories that were left out of the fit"
    if isinstance(model, StaticMlpLm):
        return "root mean square error at poses held out of the training, if there were any"
    if isinstance(model, StaticHysteresis) and len(model.penalty_):
        return "root mean square error on poses that the correction had not seen"
    return "standard deviation of the training residual"


def links_part(model: RobotEstimator) -> dict[str, Any]:
    """Full inertial parameters of links that can exist, where the model has them."""
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
