"""Export of a fitted model as one ONNX file: its PyTorch module, traced to standard operators.

Small ONNX runtimes support few operators, no subgraphs, and fixed shapes except the number of rows
(first dimension). The export removes the annotations of the tracer from the graph, and rejects a
graph with features that small runtimes do not support (`require_plain`).
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import FitError, FloatArray, plugins
from hil.estimators import RobotEstimator
from hil.export.agreement import FAULT, Step, golden_of, require_agreement
from hil.export.exported import Exported, require_new, write_file
from hil.export.torch_export import example_inputs, told_of

if TYPE_CHECKING:
    import onnx

    from hil.export.torch_modules import TorchModel


OPSET = 20
"""ONNX opset of exported files; TwinCAT TF3820 supports at most opset 21."""

NEEDED = ("torch", "onnx", "onnxscript", "onnxruntime")
"""Names of the packages of the extra `onnx`, which trace, write and check a graph."""


def export_onnx(model: RobotEstimator, out: Path) -> Exported:
    """Write a model as ONNX, after comparing it with the Python model in onnxruntime.

    Args:
        model: Fitted model.
        out: File that is created, usually with the extension `.onnx`.

    Raises:
        FitError: The estimator cannot be exported, the graph does not agree with the model, or
            small runtimes do not support the graph.
        PluginError: A package of the extra `onnx` is not installed.
        RecordingError: The file already exists, or cannot be created.
    """
    require_new(out)
    require_onnx()
    from hil.export.torch_modules import module_of

    traced = module_of(model)
    content = graph(traced)
    checked = require_agreement(
        loaded(content), golden_of(model), traced.state_size, "the ONNX graph"
    )
    write_file(content, out)
    return told_of(traced, out, checked, f"opset {OPSET}, {nodes(content)} nodes")


def require_onnx() -> None:
    """Raise if a required package is not installed.

    Raises:
        PluginError: The extra `onnx`, or one of its packages, is not installed.
    """
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise plugins.not_installed("--to onnx", missing, "onnx")


def graph(traced: TorchModel) -> bytes:
    """Return the content of the ONNX file: opset 20, fixed shapes except the number of rows.

    Raises:
        FitError: The graph has operators or shapes that small runtimes do not support.
    """
    import torch

    inputs = example_inputs(traced, 2)
    rows = torch.export.Dim("rows", min=1)
    taken, given = traced.names
    with torch.no_grad(), _quiet():
        program = torch.export.export(
            traced.module, inputs, dynamic_shapes=tuple({0: rows} for _ in inputs)
        )
        written = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=OPSET,
            input_names=list(taken),
            output_names=list(given),
            verbose=False,
        )
    found = cleaned(written.model_proto, traced.metadata())
    require_plain(found)
    content: bytes = found.SerializeToString()
    return content


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings of the tracer about torchvision and about deprecated functions."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def nodes(content: bytes) -> int:
    """Return the number of operations in the graph."""
    import onnx

    return len(onnx.load_from_string(content).graph.node)


def loaded(content: bytes) -> Step:
    """Return the graph as a function, which onnxruntime runs on one CPU thread."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]

    def step(inputs: Sequence[FloatArray]) -> Sequence[FloatArray]:
        found: list[FloatArray] = session.run(None, dict(zip(names, inputs, strict=True)))
        return found

    return step


ROWS = "rows"
"""Name of the leading dimension, which is the only variable dimension."""

NEWEST_OPSET, NEWEST_IR = 21, 10
"""Newest opset and format version that TF3820 and an onnxruntime of the same age support."""

OPERATORS = frozenset({
    "Abs", "Add", "Cast", "Concat", "Cos", "Div", "Exp", "Gemm", "Greater", "Log", "MatMul", "Max",
    "Min", "Mul", "Neg", "Reciprocal", "ReduceSum", "Relu", "Reshape", "Sigmoid", "Sign", "Sin",
    "Slice", "Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
    "Where",
})  # fmt: skip
"""Operators in exported graphs, without gathers, scatters, branches and shape queries."""

TRIED = (1, 3)
"""Numbers of rows with which a graph is checked: every shape must follow from the input shapes."""


def cleaned(model: onnx.ModelProto, told: Mapping[str, str]) -> onnx.ModelProto:
    """Return a copy of the graph with metadata, and without annotations about the source code.

    Args:
        model: Traced model.
        told: Metadata of the file (`metadata_props`).
    """
    import onnx

    found = onnx.ModelProto()
    found.CopyFrom(model)
    found.producer_name, found.producer_version = "hil", ""
    graph = found.graph
    graph.name = told["estimator"]
    del graph.value_info[:]
    for part in (found, graph, *graph.node, *graph.input, *graph.output, *graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""
    for value in (*graph.input, *graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = ROWS
    onnx.helper.set_model_props(found, dict(told))
    return found


def require_plain(model: onnx.ModelProto) -> None:
    """Raise if a graph is invalid, or if restricted runtimes do not support it.

    Raises:
        FitError: The graph contains an operator of a different domain or outside `OPERATORS`, a
            subgraph, a format that is too new, an input or output with a variable dimension other
            than the number of rows, or a shape that is only known at run time.
    """
    import onnx

    strange = [function.name for function in model.functions]
    strange += [opset.domain for opset in model.opset_import if opset.domain]
    strange += [one.op_type for one in nodes_of(model.graph) if one.op_type not in OPERATORS]
    strange += [f"opset {one.version}" for one in model.opset_import if one.version > NEWEST_OPSET]
    strange += [f"format {model.ir_version}"] * (model.ir_version > NEWEST_IR)
    if strange:
        raise FitError(
            "the ONNX graph has elements that small runtimes do not support: "
            f"{', '.join(sorted(set(strange)))}",
            hint=FAULT,
        )
    try:
        onnx.checker.check_model(model, full_check=True)
        loose = open_ends(model)
        for rows in TRIED:
            loose += unknown_shapes(model, rows) if not loose else []
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise FitError(f"the ONNX graph is not valid: {error}", hint=FAULT) from error
    if loose:
        raise FitError(
            f"the ONNX graph has shapes that are not fixed: {', '.join(loose[:5])}", hint=FAULT
        )


def nodes_of(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """Yield all nodes, including those of subgraphs."""
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            for inner in (attribute.g, *attribute.graphs):
                yield from nodes_of(inner)


def open_ends(model: onnx.ModelProto) -> list[str]:
    """Return inputs and outputs with a variable dimension other than a leading `rows`."""
    found = []
    for value in (*model.graph.input, *model.graph.output):
        first, *others = value.type.tensor_type.shape.dim or [None]
        named = first is not None and first.dim_param == ROWS
        if not named or any(one.dim_value < 1 for one in others):
            found.append(value.name)
    return found


def unknown_shapes(model: onnx.ModelProto, rows: int) -> list[str]:
    """Return the values whose shape does not follow from inputs with the passed number of rows."""
    import onnx

    fixed = onnx.ModelProto()
    fixed.CopyFrom(model)
    del fixed.graph.value_info[:]
    for value in (*fixed.graph.input, *fixed.graph.output):
        value.type.tensor_type.shape.dim[0].dim_value = rows
    inferred = onnx.shape_inference.infer_shapes(fixed, strict_mode=True, data_prop=True).graph
    known = {
        value.name
        for value in (*inferred.value_info, *inferred.output)
        if value.type.tensor_type.HasField("shape")
        and all(one.dim_value > 0 for one in value.type.tensor_type.shape.dim)
    }
    return [name for node in inferred.node for name in node.output if name not in known]
