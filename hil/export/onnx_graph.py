"""What an ONNX graph has to be to run where operators are few and shapes are fixed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import onnx

from hil.core import FitError
from hil.export.agreement import FAULT

ROWS = "rows"
"""Name of the leading dimension, the only one that is not fixed."""

NEWEST_OPSET, NEWEST_IR = 21, 10
"""What TF3820 and an onnxruntime of its age load."""

OPERATORS = frozenset({
    "Abs", "Add", "Cast", "Concat", "Cos", "Div", "Exp", "Gemm", "Greater", "Log", "MatMul", "Max",
    "Min", "Mul", "Neg", "Reciprocal", "ReduceSum", "Relu", "Reshape", "Sigmoid", "Sign", "Sin",
    "Slice", "Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
    "Where",
})  # fmt: skip
"""All that exported graphs are made of: none gathers, scatters, branches or asks for shapes."""

TRIED = (1, 3)
"""Rows with which every shape has to follow from those of the inputs."""


def cleaned(model: onnx.ModelProto, told: Mapping[str, str]) -> onnx.ModelProto:
    """A copy that says what it is, and nothing of where and from which lines it was traced.

    Args:
        model: As it was traced.
        told: Becomes `metadata_props`.
    """
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
    """Refuse a graph that is not valid, or not what restricted runtimes take.

    Raises:
        FitError: There is an operator of another domain or beyond `OPERATORS`, a subgraph, a format
            that is too new, an input or output that is open but for its leading rows, or a shape
            that is known no sooner than when it runs.
    """
    strange = [function.name for function in model.functions]
    strange += [opset.domain for opset in model.opset_import if opset.domain]
    strange += [one.op_type for one in nodes_of(model.graph) if one.op_type not in OPERATORS]
    strange += [f"opset {one.version}" for one in model.opset_import if one.version > NEWEST_OPSET]
    strange += [f"format {model.ir_version}"] * (model.ir_version > NEWEST_IR)
    if strange:
        raise FitError(
            f"the ONNX graph has what small runtimes lack: {', '.join(sorted(set(strange)))}",
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
    """All nodes, those of subgraphs among them."""
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            for inner in (attribute.g, *attribute.graphs):
                yield from nodes_of(inner)


def open_ends(model: onnx.ModelProto) -> list[str]:
    """Inputs and outputs with anything open but a leading dimension named `rows`."""
    found = []
    for value in (*model.graph.input, *model.graph.output):
        first, *others = value.type.tensor_type.shape.dim or [None]
        named = first is not None and first.dim_param == ROWS
        if not named or any(one.dim_value < 1 for one in others):
            found.append(value.name)
    return found


def unknown_shapes(model: onnx.ModelProto, rows: int) -> list[str]:
    """Values whose shape does not follow from the inputs', with that many rows."""
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
