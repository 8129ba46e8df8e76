"""Parts of a JSON document about friction laws and networks: what is done with the parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.identify.base import RobotEstimator
from hil.identify.diffnea.forms import LEAST_SPEED
from hil.identify.friction.motion import REFERENCE_C, RIPPLE_FADES_RAD_S
from hil.identify.lagrangian.fitted import LagrangianModel
from hil.identify.residual.fitted import CorrectedModel
from hil.identify.rigid_diffnea import RigidDiffnea
from hil.identify.rigid_hysteresis import RigidHysteresis
from hil.identify.rigid_irls import NARROWEST
from hil.identify.rigid_linear import RigidLinear
from hil.identify.static_friction import StaticFriction
from hil.identify.static_hysteresis import StaticHysteresis
from hil.identify.static_inverse import StaticInverse
from hil.identify.static_network import StaticMlpLm

STORED = "model.safetensors"

SMOOTH = "s = tanh(v/sign_width), the sign of v for 0"
DAHL = "z: from sample to sample z ← σ + (z − σ)·exp(−|Δq|/x0) with σ the sign of Δq, 0 at first"
SUM = "sum of value × column over the joint's parameters"
AT_REST = "d: +1 approached from below, −1 from above; z1, z2, …: Dahl's states with lengths_rad"


def friction_part(model: RobotEstimator) -> dict[str, Any]:
    """The law behind the parameters: its name, its formula and its constants."""
    if isinstance(model, CorrectedModel):
        return friction_part(model.base_)
    if isinstance(model, RigidHysteresis):
        constants = {"reference_celsius": REFERENCE_C, "ripple_fades_rad_s": RIPPLE_FADES_RAD_S}
        usual = {"usual_celsius": model.law_.celsius}
        return _law("library", f"{SUM}; {DAHL}; zk: with k times x0", True, constants | usual)
    if isinstance(model, LagrangianModel):
        return _network_law(model)
    if isinstance(model, RigidDiffnea):
        constants = {"sign_width_rad_s": model.sign_width, "least_speed_rad_s": LEAST_SPEED}
        memory = model.friction == "memory"
        how = f"{DAHL}; z10: with 10 x0" if memory else SMOOTH
        return _law(model.friction, f"{SUM}; {how}", memory, constants)
    if isinstance(model, RigidLinear):
        width = model.sign_width or NARROWEST
        constants = {"sign_width_rad_s": model.sign_width, "power_width_rad_s": width}
        words = f"{SUM}; {SMOOTH}; w = power_width"
        return _law("coulomb-viscous", words, False, constants)
    if isinstance(model, StaticFriction):
        return _at_rest(model)
    if isinstance(model, StaticInverse):
        solved = "gravity = K2·i·|i| + K1·i + K0, solved for the current i; offset is −K0"
        return _law("none", f"{solved}. Friction at rest counts as noise", False, {})
    return _law("none", "friction at rest counts as noise", False, {})


def _law(
    name: str, formula: str, memory: bool, constants: dict[str, Any], **more: Any
) -> dict[str, Any]:
    base = {"law": name, "formula": formula, "memory": memory, "constants": constants}
    return base | {"level_nm": more.get("level_nm")}


def _network_law(model: LagrangianModel) -> dict[str, Any]:
    kind, dahl = model.design_.kind, model.length_ is not None
    sign = "the sign of v" if model.design_.friction.sign == "hard" else SMOOTH
    constants = {"sign_width_rad_s": model.sign_width}
    if kind == "coulomb":
        formula = "f_c·s + f_v·v + offset"
    elif kind == "stribeck":
        formula = "s·(f_c + (f_s − f_c)·exp(−(|v|/v_s)^delta_s) + f_v·|v|^alpha) + offset"
    else:
        return _law(kind, f"{kind}: no parameters that mean anything", dahl, constants)
    return _law(kind, f"{formula}; {f'{DAHL}; s is z' if dahl else sign}", dahl, constants)


def _at_rest(model: StaticFriction) -> dict[str, Any]:
    constants: dict[str, Any] = {
        "load_limit_nm": model.load_limit_,
        "mean_celsius": model.celsius_,
    }
    if isinstance(model, StaticHysteresis):
        constants["lengths_rad"] = model.lengths_rad
        constants["gear_ratio"] = model.gear_ratio
    words = f"{SUM}; {AT_REST}; τ: gravity and load, within load_limit"
    return _law("rest", words, True, constants, level_nm=model.dry_friction())


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
