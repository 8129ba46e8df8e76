"""A small fitted model of every registered estimator, for tests of what is told about them."""

from __future__ import annotations

from functools import cache
from typing import Any

from hil.data import Dataset
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from tests.support.residual_models import SMALL as SMALL_TCN
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import arriving, dwelling, moving, nominal

TRAINING = {"epochs": 3, "batch_size": 300, "device": "cpu"}

KINDS: dict[str, dict[str, Any]] = {
    "rigid-wls": {},
    "rigid-wls hard": {"sign_width": 0.0},
    "rigid-linear": {},
    "rigid-linear ridge": {"method": "ridge", "alpha": 1e-6},
    "rigid-lmi": {},
    "rigid-irls": {},
    "rigid-irls plain": {"feasible": False, "exponent": False},
    "rigid-diffnea": {},
    "rigid-diffnea plain": {"friction": "coulomb-viscous"},
    "rigid-diffnea power": {"friction": "stribeck-power"},
    "rigid-diffnea memory": {"friction": "memory"},
    "rigid-hysteresis": {},
    "residual": {
        "base": {"estimator": "rigid-wls", "sign_width": 2.0}, "network": SMALL_TCN,
        "training": {"epochs": 1, "batch_size": 16, "device": "cpu"}, "folds": 1, "margin": 0.0,
    },
    "lagrangian": {"network": {"hidden": [12]}, "training": TRAINING},
    "lagrangian coulomb": {
        "friction": "coulomb", "direction": "dahl", "network": {"hidden": [12]},
        "training": TRAINING,
    },
    "lagrangian dissipative": {
        "friction": "dissipative", "network": {"hidden": [12]}, "training": TRAINING
    },
    "static-wls": {},
    "static-wls paper": {"form": "paper"},
    "static-wls current": {"form": "paper", "current_term": True},
    "static-linear": {},
    "static-linear lasso": {"method": "lasso"},
    "static-inverse": {},
    "static-inverse shared": {"form": "shared", "square": "free"},
    "static-coulomb": {},
    "static-hysteresis": {"gear_ratio": 101.0},
    "static-mlp-lm": {"layers": (4, 6, 1), "epochs": 20},
}  # fmt: skip
"""Name of an estimator, with a word where there are several of it, and its parameters."""


@cache
def fitted(kind: str) -> RobotEstimator:
    """Not to be changed."""
    name = kind.split()[0]
    return estimator(name, **KINDS[kind]).fit(_data(kind), nominal())


def _data(kind: str) -> Dataset:
    name = kind.split()[0]
    if name in ("static-coulomb", "static-hysteresis"):
        return arriving(60, load_share=0.1)
    if name.startswith("static"):
        return dwelling(80, stiction_nm=1.0)
    if name == "rigid-hysteresis" or kind.endswith(("memory", "coulomb")):
        return remembering(1, 2, 3, samples=500)
    return moving(1, 2, 3, noise_a=0.02)
