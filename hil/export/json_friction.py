"""Parts of a JSON document about friction laws and networks: what is done with the parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.estimators import (
    LEAST_SPEED,
    NARROWEST,
    REFERENCE_C,
    RIPPLE_FADES_RAD_S,
    RigidDiffnea,
    RigidHysteresis,
    RigidIrls,
    RigidLinear,
    RobotEstimator,
    StaticFriction,
    StaticHysteresis,
    StaticInverse,
    StaticModel,
)
from hil.export.json_terms import NETWORK
from hil.export.lagrangian_terms import LEAST_SPEED as LEAST_NETWORK_SPEED
from hil.networks import CorrectedModel, LagrangianModel, StaticMlpLm

STORED = "model.safetensors"

SUM = "sum of value × column over the joint's parameters"
SMOOTH = "s = tanh(v/sign_width_rad_s), the sign of v for 0"
DAHL = (
    "z: at first 0; from sample to sample z ← σ + (z − σ)·exp(−|Δq|/x0), σ the sign of Δq, where "
    "Δq·v > 0; elsewhere, and so for v = 0, z stays; z3, z10, …: with 3, 10, … times x0"
)
V0 = "v0 = least_speed_rad_s"
SYMBOLS = "vf = ripple_fades_rad_s; T0 = reference_celsius; T = usual_celsius (T0 without)"
AT_REST = (
    "d: +1 approached from below, −1 from above; z1, z2, …: Dahl's states with lengths_rad along "
    "the smoothed path into the pose; τ: the group gear and load, within load_limit_nm; "
    "N = gear_ratio; Tm = mean_celsius"
)


def friction_part(model: RobotEstimator) -> dict[str, Any]:
    """The law behind the parameters: its name, its formula and its constants."""
    if isinstance(model, CorrectedModel):
        return friction_part(model.base_)
    if isinstance(model, RigidHysteresis):
        constants = {"reference_celsius": REFERENCE_C, "ripple_fades_rad_s": RIPPLE_FADES_RAD_S}
        usual = {"usual_celsius": model.law_.celsius}
        return _law("library", f"{SUM}; {DAHL}; {SYMBOLS}", True, constants | usual)
    if isinstance(model, LagrangianModel):
        return _network_law(model)
    if isinstance(model, RigidDiffnea):
        memory, width = model.friction == "memory", {"sign_width_rad_s": model.sign_width}
        words = f"{SUM}; {SMOOTH}; {V0}" + f"; {DAHL}" * memory
        return _law(model.friction, words, memory, width | {"least_speed_rad_s": LEAST_SPEED})
    if isinstance(model, RigidLinear):
        constants = {"sign_width_rad_s": model.sign_width}
        if not isinstance(model, RigidIrls):
            return _law("coulomb-viscous", f"{SUM}; {SMOOTH}", False, constants)
        constants["power_width_rad_s"] = model.sign_width or NARROWEST
        words = f"{SUM}; {SMOOTH}; w = power_width_rad_s"
        return _law("coulomb-viscous", words, False, constants)
    if isinstance(model, StaticFriction):
        return _at_rest(model)
    noise = "friction at rest counts as noise"
    if isinstance(model, StaticInverse):
        solved = "gravity = K2·i·|i| + K1·i + K0, solved for the current i; offset is −K0"
        return _law("none", f"{solved}; {noise}", False, {})
    if isinstance(model, StaticMlpLm):
        return _law("network", f"{SUM}; friction at rest is what the networks say", False, {})
    if isinstance(model, StaticModel):
        return _law("none", f"{SUM}; {noise}", False, {})
    return _law("unknown", "of an estimator that this version of hil does not know", False, {})


def _law(
    name: str, formula: str, memory: bool, constants: dict[str, Any], **more: Any
) -> dict[str, Any]:
    base = {"law": name, "formula": formula, "memory": memory, "constants": constants}
    return base | {"level_nm": more.get("level_nm")}


def remembers(model: LagrangianModel) -> bool:
    """Whether friction has Dahl's state for the sign of the velocity."""
    return model.length_ is not None and model.design_.friction.sign != "hard"


def _network_law(model: LagrangianModel) -> dict[str, Any]:
    kind, hard = model.design_.kind, model.design_.friction.sign == "hard"
    if kind not in NETWORK:
        return _law(kind, f"{kind}: no parameters that mean anything", False, {})
    constants = {} if remembers(model) else {"sign_width_rad_s": 0.0 if hard else model.sign_width}
    sign = DAHL if remembers(model) else SMOOTH
    if kind == "stribeck":
        constants["least_speed_rad_s"] = LEAST_NETWORK_SPEED
        sign = f"{sign}; {V0}"
    return _law(kind, f"{SUM}; {sign}", remembers(model), constants)


def _at_rest(model: StaticFriction) -> dict[str, Any]:
    constants: dict[str, Any] = {
        "load_limit_nm": model.load_limit_,
        "mean_celsius": model.celsius_,
    }
    if isinstance(model, StaticHysteresis):
        constants["lengths_rad"] = model.lengths_rad
        constants["gear_ratio"] = model.gear_ratio
    return _law("rest", f"{SUM}; {AT_REST}", True, constants, level_nm=model.dry_friction())


def networks_part(model: RobotEstimator) -> list[dict[str, Any]]:
    """What was learnt that no single number tells: sizes, and where the weights lie."""
    if isinstance(model, CorrectedModel):
        return [_residual(model), *networks_part(model.base_)]
    if isinstance(model, LagrangianModel):
        weights = sum(int(w.size) for w in model.weights_.values() if w.dtype.kind == "f")
        what = "inertia matrix and potential of the arm, and friction where it is a network"
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


def _residual(model: CorrectedModel) -> dict[str, Any]:
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
    what = "what the physics leaves in motion, in effort units: the mean of the networks"
    told = _network(what, len(correction.networks), weights, "network", inputs, layout, model)
    kept = zip(model.joint_names_, correction.kept, strict=True)
    return told | {"joints": [name for name, own in kept if own], "limit": correction.limit}


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
