"""Export of fully connected layers as ONNX, for runtimes without other operators (TwinCAT TF38x0).

The graph has one input, a sequence of `Gemm` nodes with activations between them, and one output.
The numbers of the graph are float32, the opset is old, and the scaling is part of the first and the
last layer. Runtimes such as TF38x0 support no products of intermediate results, no convolutions and
no memory. The exported layers are therefore never the complete dynamics of an arm. For
`static-mlp-lm` the exported layers compute the friction, and for `lagrangian` the functions whose
derivatives give the torque.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from hil.core import BoolArray, FitError, FloatArray, plugins
from hil.estimators import RobotEstimator
from hil.export.agreement import AGREES, FAULT, RATE_HZ, SAMPLES, motion, scale_of
from hil.export.exported import Exported, effort_unit, require_new, write_file
from hil.export.program import LagrangianTerms, lagrangian_terms
from hil.networks import LagrangianEstimator, StaticMlpLm, position_inputs, positions_only

OPSET, IR_VERSION = 13, 7
"""Oldest ONNX versions with every operator in the required form; converters lag behind ONNX."""

LIBRARIES = ("onnx", "onnxruntime")


def export_onnx_mlp(model: RobotEstimator, out: Path) -> Exported:
    """Write the fully connected layers of a model, after a comparison in onnxruntime.

    The input of the graph is `q` (rows, n) [rad]. The outputs of the graph are (rows, m); the
    metadata of the file contain their names and units.

    Args:
        model: Fitted model: `static-mlp-lm` (its friction is exported) or `lagrangian` (its trunk
            is exported).
        out: File that is created.

    Raises:
        FitError: The model contains no fully connected layers of this kind, or the file does not
            agree with the model.
        PluginError: The package onnx or onnxruntime is not installed.
        RecordingError: The file already exists, or cannot be created.
    """
    require_new(out)
    chain = chain_of(model)
    if missing := [name for name in LIBRARIES if find_spec(name) is None]:
        raise plugins.not_installed("--to onnx", missing, "onnx")
    told = _told(model, chain)
    content = _onnx_file(chain, model.robot_.n, told)
    checked = _checked(content, chain, motion(model.robot_, SAMPLES, RATE_HZ)[0])
    write_file(content, out)
    unit = effort_unit(model.effort_kind_) if chain.output == "friction" else ""
    parts = f"{model.estimator}, {chain.part}"
    return Exported(out, (out.name,), model.joint_names_, unit, parts, checked, chain.notes)


def _told(model: RobotEstimator, chain: Chain) -> dict[str, str]:
    """Return the metadata of the ONNX file."""
    lists = {
        "inputs": model.joint_names_,
        "input_units": tuple("rad" if one else "m" for one in model.robot_.joint_geometry().turns),
        "outputs": chain.outputs,
        "output_units": chain.units,
        "notes": chain.notes,
    }
    # Only the file name: the folder is private and does not identify the robot.
    robot = Path(model.robot_.name).name
    words = {"estimator": model.estimator, "robot": robot, "part": chain.part}
    return words | {name: json.dumps(all_, ensure_ascii=False) for name, all_ in lists.items()}


def _onnx_file(chain: Chain, n: int, told: dict[str, str]) -> bytes:
    from onnx import TensorProto, checker, helper, shape_inference

    nodes: list[Any] = []
    constants: list[Any] = []
    at = "q"
    for number, layer in enumerate(chain.layers, start=1):
        last = chain.output if number == len(chain.layers) else ""
        at = _add(layer, number, at, last, nodes, constants)
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", size])
        for name, size in (("q", n), (chain.output, len(chain.outputs)))
    ]
    graph = helper.make_graph(nodes, "hil", ends[:1], ends[1:], constants)
    opset = [helper.make_opsetid("", OPSET)]
    made = helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="hil")
    helper.set_model_props(made, told)
    try:
        checker.check_model(made, full_check=True)
    except (checker.ValidationError, shape_inference.InferenceError) as error:
        raise FitError(f"the ONNX graph is not valid: {error}", hint=FAULT) from error
    content: bytes = made.SerializeToString()
    return content


OPERATORS = {"softplus": "Softplus", "relu": "Relu", "tanh": "Tanh", "sin": "Sin", "linear": ""}
"""Mapping from activation to ONNX operator; all runtimes such as TF38x0 support the operators."""


def _add(
    layer: Layer, number: int, at: str, last: str, nodes: list[Any], constants: list[Any]
) -> str:
    """Append a layer to the nodes and constants of a graph; return the name of its output."""
    from onnx import helper, numpy_helper

    names = [f"weight{number}", f"bias{number}"]
    for name, values in zip(names, (layer.weight, layer.bias), strict=True):
        constants.append(numpy_helper.from_array(values.astype(np.float32), name))
    operator = OPERATORS[layer.activation]
    total = f"sum{number}" if operator or not last else last
    nodes.append(helper.make_node("Gemm", [at, *names], [total], name=f"layer{number}"))
    if not operator:
        return total
    value = last or f"value{number}"
    nodes.append(helper.make_node(operator, [total], [value], name=f"{layer.activation}{number}"))
    return value


def _checked(content: bytes, chain: Chain, q: FloatArray) -> str:
    """Return a text with the largest difference between onnxruntime and the model.

    Raises:
        FitError: The largest difference exceeds the tolerance.
    """
    wanted = chain.says(q)
    off = np.abs(onnxruntime_says(content)(q) - wanted).max(axis=0)
    worst = float(np.max(off / scale_of(wanted)))
    if not worst <= AGREES:
        raise FitError(
            f"the ONNX file does not agree with the model: largest difference {worst:.1e}",
            hint=FAULT,
        )
    return f"onnxruntime: largest difference {worst:.2e} of each output's largest value"


def onnxruntime_says(content: bytes) -> Callable[[FloatArray], FloatArray]:
    """Return the content of an ONNX file as a function of q (N, n), which onnxruntime computes."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])

    def says(q: FloatArray) -> FloatArray:
        return np.asarray(session.run(None, {"q": q.astype(np.float32)})[0], dtype=np.float64)

    return says


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """Fully connected layer: activation(x @ weight + bias).

    Attributes:
        weight: (inputs, outputs) weights.
        bias: (outputs,) biases.
        activation: Name of the activation function in `OPERATORS`.
    """

    weight: FloatArray
    bias: FloatArray
    activation: str = "linear"


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Sequence of layers from q (N, n) [rad] to outputs (N, m), and the meaning of the outputs.

    Attributes:
        layers: List of the layers in their order.
        says: Function of the Python model that computes the same outputs (N, m) from q (N, n).
        part: Short description of the exported part of the model.
        output: Common name of the outputs.
        outputs, units: Names and units of the m outputs.
        notes: Notes on the use of the outputs.
    """

    layers: tuple[Layer, ...]
    says: Callable[[FloatArray], FloatArray]
    part: str
    output: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    notes: tuple[str, ...]


def chain_of(model: RobotEstimator) -> Chain:
    """Return the fully connected layers of a fitted model.

    Raises:
        FitError: The model is not fitted, or contains no sequence of fully connected layers.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    if isinstance(model, StaticMlpLm):
        return _static(model)
    if isinstance(model, LagrangianEstimator):
        return _trunk(model)
    raise FitError(
        f"{model.estimator} is not a chain of fully connected layers",
        hint="onnx-mlp supports static-mlp-lm (its friction) and lagrangian (its trunk); export "
        "whole models with --to c for a controller, or with --to onnx for onnxruntime and "
        "TF3820",
    )


def _static(model: StaticMlpLm) -> Chain:
    names = list(model.inputs)
    if not positions_only(names):
        raise FitError(
            f"the network has the inputs {', '.join(names)}, not all of which are positions",
            hint="fit static-mlp-lm with position inputs only, such as [q2, q3, q4, q5]",
        )
    unit, slides = effort_unit(model.effort_kind_), ~model.robot_.joint_geometry().turns
    return Chain(
        _side_by_side(model, position_inputs(np.eye(model.robot_.n), names)),
        lambda q: model.networks_.predict(position_inputs(q, names)),
        "its friction at standstill only",
        "friction",
        model.joint_names_,
        tuple("N" if one and unit != "A" else unit for one in slides),
        ("the output is friction at standstill, to be added to gravity; it is not the effort",),
    )


def _side_by_side(model: StaticMlpLm, chosen: FloatArray) -> tuple[Layer, ...]:
    """Return the networks of all joints combined into one network that includes the scaling.

    The matrix `chosen` (n, d) selects the inputs from q.
    """
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
    """Return layers whose output is multiplied by `scale` and shifted by `mean`.

    A separate layer is added only if the last layer is not linear.
    """
    last = layers[-1]
    if last.activation != "linear":
        return (*layers, Layer(np.diag(scale), mean))
    return (*layers[:-1], Layer(last.weight * scale, last.bias * scale + mean))


def _trunk(model: LagrangianEstimator) -> Chain:
    terms = lagrangian_terms(model)
    if terms.activation not in OPERATORS:
        raise FitError(
            f"the network has {terms.activation} layers, which multiply intermediate results",
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
        tuple(layers), _trunk_says(model, scale), "its trunk only", "lagrangian", names, units,
        ("the output is the trunk q → (L, V), not the torque, which needs its derivatives",
         _formula(terms, turns)),
    )  # fmt: skip


def _outputs(
    terms: LagrangianTerms, joints: Sequence[str], turns: BoolArray
) -> tuple[tuple[str, ...], tuple[str, ...], FloatArray]:
    """Return names, units and factors of the raw outputs; the diagonal of L is not scaled."""
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


def _turned(n: int) -> Layer:
    """Return a layer for [cos q, sin q], which is computed with cos q = sin(q + π/2)."""
    eye = np.eye(n)
    return Layer(np.hstack([eye, eye]), np.r_[np.full(n, np.pi / 2), np.zeros(n)], "sin")


def _trunk_says(
    model: LagrangianEstimator, scale: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    def says(q: FloatArray) -> FloatArray:
        import torch

        from hil.networks import network_of

        network = network_of(model.design_, model.torque_std_, model.weights_).double()
        with torch.no_grad():
            raw = network.dynamics.trunk(torch.as_tensor(q, dtype=torch.float64))
        return np.asarray(raw.numpy() * scale)

    return says


def _formula(terms: LagrangianTerms, turns: BoolArray) -> str:
    curve = "max(d, 0)" if terms.rectified else "log(1 + exp d)"
    unit = ", ".join(f"{value:.9g}" for value in terms.unit)
    added = f" + {terms.added:g}·identity" if terms.added else ""
    diagonal = f"Lii = unit_i·({curve} + {terms.least:g}), unit = ({unit}) √(kg·m²)"
    diagonal += " (√kg for prismatic joints)" * (not np.all(turns))
    return f"M(q) = L·Lᵀ{added} with {diagonal}"
