"""Which models are, or hold, a chain of fully connected layers that begins with the positions.

Runtimes for such chains know no products of what they computed, no convolution and no memory, so
this is never a whole dynamics: of `static-mlp-lm` it is the friction, of `lagrangian` what its
torque is the derivative of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from hil.core import BoolArray, FitError, FloatArray
from hil.estimators import RobotEstimator
from hil.export.exported import effort_unit
from hil.export.lagrangian_terms import LagrangianTerms, lagrangian_terms
from hil.networks import LagrangianModel, StaticMlpLm, position_inputs, positions_only

OPERATORS = {"softplus": "Softplus", "relu": "Relu", "tanh": "Tanh", "sin": "Sin", "linear": ""}
"""Activations that all runtimes of this kind know, as ONNX calls them; a chain adds no others."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """activation(x @ weight + bias).

    Attributes:
        weight: (inputs, outputs).
        bias: (outputs,).
        activation: A name in `OPERATORS`.
    """

    weight: FloatArray
    bias: FloatArray
    activation: str = "linear"


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Layers from q (N, n) [rad] to outputs (N, m), and what they mean.

    Attributes:
        layers: One behind the other.
        says: What the model in Python says, q (N, n) to (N, m).
        part: Of the model, in a few words.
        output: Name of the outputs together.
        outputs, units: m names and units.
        notes: What has to be known to use them.
    """

    layers: tuple[Layer, ...]
    says: Callable[[FloatArray], FloatArray]
    part: str
    output: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    notes: tuple[str, ...]


def chain_of(model: RobotEstimator) -> Chain:
    """The chain in a fitted model.

    Raises:
        FitError: It is not fitted, or neither is nor holds one.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    if isinstance(model, StaticMlpLm):
        return _static(model)
    if isinstance(model, LagrangianModel):
        return _trunk(model)
    raise FitError(
        f"{model.estimator} is no chain of fully connected layers",
        hint="onnx-mlp takes static-mlp-lm (its friction) and lagrangian (its trunk); whole models "
        "are written with --to c for a controller, with --to onnx for onnxruntime and TF3820",
    )


def _static(model: StaticMlpLm) -> Chain:
    names = list(model.inputs)
    if not positions_only(names):
        raise FitError(
            f"the network has the inputs {', '.join(names)}, not all of which are positions",
            hint="fit static-mlp-lm with inputs of q alone, such as [q2, q3, q4, q5]",
        )
    unit, slides = effort_unit(model.effort_kind_), ~model.robot_.joint_geometry().turns
    return Chain(
        _side_by_side(model, position_inputs(np.eye(model.robot_.n), names)),
        lambda q: model.networks_.predict(position_inputs(q, names)),
        "its friction at standstill alone",
        "friction",
        model.joint_names_,
        tuple("N" if one and unit != "A" else unit for one in slides),
        ("friction of an arm at rest, which adds to gravity; it is not the effort",),
    )


def _side_by_side(model: StaticMlpLm, chosen: FloatArray) -> tuple[Layer, ...]:
    """All joints' networks as one, scaling folded in; `chosen` (n, d) picks inputs from q."""
    networks = model.networks_
    scaling, mlp, count = networks.scaling, networks.mlp, len(networks.weights)
    mean, scale = (np.broadcast_to(v, (count, v.shape[1]))
                   for v in (scaling.input_mean, scaling.input_scale))  # fmt: skip
    layers = []
    matrices = mlp.matrices(networks.weights)
    for depth, (stack, activation) in enumerate(zip(matrices, mlp.activations, strict=True)):
        weights, biases = list(stack[:, :-1]), stack[:, -1]
        if depth == 0:
            weights = [w / s[:, None] for w, s in zip(weights, scale, strict=True)]
            biases = biases - np.einsum("bi,biu->bu", mean, np.stack(weights))
            joined = np.hstack([chosen @ w for w in weights])
        else:
            joined = block_diag(*weights)
        layers.append(Layer(joined, biases.ravel(), activation))
    return _scaled(layers, scaling.target_scale, scaling.target_mean)


def _scaled(layers: list[Layer], scale: FloatArray, mean: FloatArray) -> tuple[Layer, ...]:
    """What comes out times `scale` plus `mean`, in a layer of its own only if it has to be."""
    last = layers[-1]
    if last.activation != "linear":
        return (*layers, Layer(np.diag(scale), mean))
    return (*layers[:-1], Layer(last.weight * scale, last.bias * scale + mean))


def _trunk(model: LagrangianModel) -> Chain:
    terms = lagrangian_terms(model)
    if terms.activation not in OPERATORS:
        raise FitError(
            f"the network has {terms.activation} layers, which multiply what they computed",
            hint="fit lagrangian with network: {activation: softplus}, tanh or relu",
        )
    turns = model.robot_.joint_geometry().turns
    names, units, scale = _outputs(terms, model.joint_names_, turns)
    weights, biases = terms.trunk.weights, terms.trunk.biases
    layers = [Layer(w.T, b, terms.activation) for w, b in zip(weights, biases, strict=True)]
    layers[-1] = Layer(weights[-1].T * scale, biases[-1] * scale)
    if terms.sincos:
        layers.insert(0, _turned(model.robot_.n))
    return Chain(
        tuple(layers), _trunk_says(model, scale), "its trunk alone", "lagrangian", names, units,
        ("the trunk q → (L, V), not the torque: that takes its derivatives",
         _formula(terms, turns)),
    )  # fmt: skip


def _turned(n: int) -> Layer:
    """[cos q, sin q] as a layer: the cosine is the sine of a quarter turn more."""
    eye = np.eye(n)
    return Layer(np.hstack([eye, eye]), np.r_[np.full(n, np.pi / 2), np.zeros(n)], "sin")


def _outputs(
    terms: LagrangianTerms, joints: Sequence[str], turns: BoolArray
) -> tuple[tuple[str, ...], tuple[str, ...], FloatArray]:
    """Names, units and what to multiply raw outputs by; L's diagonal stays raw."""
    n = len(joints)
    below = [(i, j) for i in range(n) for j in range(i)]
    lows = [f"L{i + 1},{j + 1}" for i, j in below]
    ends = ["V"] if terms.potential else [f"g {joint}" for joint in joints]
    names = [f"d{i + 1}" for i in range(n)] + lows + ends
    roots = ["√(kg·m²)" if turns[i] else "√kg" for i, _ in below]
    torques = ["N·m" if one else "N" for one in turns]
    units = ["1"] * n + roots + (["J"] if terms.potential else torques)
    scale = np.r_[np.ones(n), [terms.unit[i] for i, _ in below], terms.gravity_unit]
    return tuple(names), tuple(units), scale


def _formula(terms: LagrangianTerms, turns: BoolArray) -> str:
    curve = "max(d, 0)" if terms.rectified else "log(1 + exp d)"
    unit = ", ".join(f"{value:.9g}" for value in terms.unit)
    added = f" + {terms.added:g}·identity" if terms.added else ""
    diagonal = f"Lii = unit_i·({curve} + {terms.least:g}), unit = ({unit}) √(kg·m²)"
    diagonal += " (√kg where joints slide)" * (not np.all(turns))
    return f"M(q) = L·Lᵀ{added} with {diagonal}"


def _trunk_says(model: LagrangianModel, scale: FloatArray) -> Callable[[FloatArray], FloatArray]:
    def says(q: FloatArray) -> FloatArray:
        import torch

        from hil.networks import network_of

        network = network_of(model.design_, model.torque_std_, model.weights_).double()
        with torch.no_grad():
            raw = network.dynamics.trunk(torch.as_tensor(q, dtype=torch.float64))
        return np.asarray(raw.numpy() * scale)

    return says
