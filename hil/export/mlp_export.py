"""A chain of fully connected layers as ONNX, for runtimes that know nothing else (TwinCAT TF38x0).

One input, one `Gemm` after another with an activation between, one output: float32, an old opset,
scaling folded into the first and the last layer.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, plugins
from hil.estimators import RobotEstimator
from hil.export.agreement import FAULT, scale_of
from hil.export.exported import Exported, effort_unit, require_new, write_file
from hil.export.golden import AGREES, RATE_HZ, SAMPLES, motion
from hil.export.mlp_nets import OPERATORS, Chain, Layer, chain_of

OPSET, IR_VERSION = 13, 7
"""The oldest that have every operator as it is used here: converters lag behind ONNX."""

LIBRARIES = ("onnx", "onnxruntime")


def export_onnx_mlp(model: RobotEstimator, out: Path) -> Exported:
    """Write what is a chain of fully connected layers in a model, after onnxruntime has agreed.

    Input `q` (rows, n) [rad]; outputs (rows, m) with names and units in the file's metadata.

    Args:
        model: Fitted: `static-mlp-lm` (its friction) or `lagrangian` (its trunk).
        out: File to be made.

    Raises:
        FitError: The model holds no such chain, or the file does not agree with it.
        PluginError: onnx or onnxruntime is not installed.
        RecordingError: The file exists already, or cannot be made.
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
    """What the file says of itself."""
    lists = {
        "inputs": model.joint_names_,
        "input_units": tuple("rad" if one else "m" for one in model.robot_.joint_geometry().turns),
        "outputs": chain.outputs,
        "output_units": chain.units,
        "notes": chain.notes,
    }
    # A path says where somebody keeps files, not what robot it is.
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


def _add(
    layer: Layer, number: int, at: str, last: str, nodes: list[Any], constants: list[Any]
) -> str:
    """Append a layer; where its values are."""
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
    """How well onnxruntime agrees with the model.

    Raises:
        FitError: It does not.
    """
    wanted = chain.says(q)
    off = np.abs(onnxruntime_says(content)(q) - wanted).max(axis=0)
    worst = float(np.max(off / scale_of(wanted)))
    if not worst <= AGREES:
        raise FitError(
            f"the ONNX file does not agree with the model: off by {worst:.1e}",
            hint=FAULT,
        )
    return f"onnxruntime: largest difference {worst:.2e} of each output's largest value"


def onnxruntime_says(content: bytes) -> Callable[[FloatArray], FloatArray]:
    """The file of a chain as a function of q (N, n)."""
    import onnxruntime

    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])

    def says(q: FloatArray) -> FloatArray:
        return np.asarray(session.run(None, {"q": q.astype(np.float32)})[0], dtype=np.float64)

    return says
