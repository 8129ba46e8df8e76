"""Small Lagrangian networks of every kind, hardly trained: what they say is no matter."""

from __future__ import annotations

from functools import cache
from typing import Any

from hil.estimators import estimator
from tests.support.synthetic_motion import moving, nominal

QUICK: dict[str, Any] = {"epochs": 1, "batch_size": 300, "device": "cpu"}
DOUBLE: dict[str, Any] = {"training": {**QUICK, "precision": "float64"}}
NETWORKS = {"hidden": [20, 9]}

CASES: dict[str, dict[str, Any]] = {
    "stribeck": {},
    "stribeck double": DOUBLE,
    "stribeck dahl": {**DOUBLE, "direction": "dahl"},
    "stribeck hard": {**DOUBLE, "sign_width": 0.0},
    "coulomb": {**DOUBLE, "friction": "coulomb"},
    "coulomb dahl": {**DOUBLE, "friction": "coulomb", "direction": "dahl"},
    "none": {**DOUBLE, "friction": "none"},
    "dissipative": {"friction": "dissipative", "friction_settings": NETWORKS},
    "dissipative double": {
        **DOUBLE, "friction": "dissipative", "friction_settings": NETWORKS, "direction": "dahl",
    },
    "unconstrained": {
        **DOUBLE, "friction": "unconstrained", "friction_settings": {"hidden": []},
    },
    "paper": {"protocol": "paper"},
    "paper double": {**DOUBLE, "protocol": "paper"},
    "tanh": {
        "network": {"hidden": [136], "activation": "tanh", "features": "raw", "epsilon_of": "mass"}
    },
    "silu": {"network": {"hidden": [16], "activation": "silu", "gravity": "head"}},
    "silu double": {
        **DOUBLE, "network": {"hidden": [5], "activation": "silu", "diagonal": "relu"},
    },
}  # fmt: skip
"""Parameters that together use all that the estimator offers."""


@cache
def lagrangian(case: str) -> Any:
    """A fitted model; not to be changed."""
    params = {"network": {"hidden": [12, 20]}, "training": QUICK, **CASES[case]}
    return estimator("lagrangian", **params).fit(moving(1, 2, noise_a=0.02), nominal())
