"""Rigid-body models, regressors, base parameters, friction columns and collision distances.

Importing this package loads nothing heavy; Pinocchio comes with the first name that needs it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.dynamics.base import (
        BaseParameters,
        Conditioning,
        base_parameters,
        conditioning,
    )
    from hil.dynamics.collision import CollisionModel
    from hil.dynamics.environment import Box, Environment, Plane, payload_capsule
    from hil.dynamics.friction import coulomb_viscous_columns, friction_terms, joint_columns
    from hil.dynamics.inertial import payload_parameters
    from hil.dynamics.robot_model import RobotModel, load_model

__all__ = [
    "BaseParameters",
    "Box",
    "CollisionModel",
    "Conditioning",
    "Environment",
    "Plane",
    "RobotModel",
    "base_parameters",
    "conditioning",
    "coulomb_viscous_columns",
    "friction_terms",
    "joint_columns",
    "load_model",
    "payload_capsule",
    "payload_parameters",
]

_MODULES = {
    "base": ("BaseParameters", "Conditioning", "base_parameters", "conditioning"),
    "collision": ("CollisionModel",),
    "environment": ("Box", "Environment", "Plane", "payload_capsule"),
    "friction": ("coulomb_viscous_columns", "friction_terms", "joint_columns"),
    "inertial": ("payload_parameters",),
    "robot_model": ("RobotModel", "load_model"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"hil.dynamics.{module}"), name)
    raise AttributeError(f"module 'hil.dynamics' has no attribute {name!r}")
