"""What an ONNX graph has to be to run where operators are few and shapes are fixed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import onnx

from hil.errors import FitError

ROWS = "rows"
"""Name of the leading dimension, the only one that is not fixed."""

LACKED = ("Gather", "Scatter", "Loop", "If", "Scan", "Sequence", "NonZero", "Shape", "Range")
"""What the names of operators begin with that restricted runtimes lack, or that hide shapes."""


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
        FitError: There is an operator of another domain or of `LACKED`, a subgraph, or a shape
            that is known no sooner than when it runs.
    """
    strange = [function.name for function in model.functions]
    strange += [opset.domain for opset in model.opset_import if opset.domain]
    strange += [node.op_type for node in nodes_of(model.graph) if node.op_type.startswith(LACKED)]
    if strange:
        raise FitError(
            f"the ONNX graph has what small runtimes lack: {', '.join(sorted(set(strange)))}",
            hint="this is a fault of hil's export: please report it with the model's folder",
        )
    onnx.checker.check_model(model, full_check=True)
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
    if loose := [name for name, open_ends in shapes_of(inferred.graph) if open_ends > 1]:
        raise FitError(
            f"the ONNX graph has shapes that are not fixed: {', '.join(loose[:5])}",
            hint="this is a fault of hil's export: please report it with the model's folder",
        )


def nodes_of(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """All nodes, those of subgraphs among them."""
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            for inner in (attribute.g, *attribute.graphs):
                yield from nodes_of(inner)


def shapes_of(graph: onnx.GraphProto) -> Iterator[tuple[str, int]]:
    """Name of each value, and how many of its dimensions are not fixed."""
    for value in (*graph.input, *graph.output, *graph.value_info):
        dims = value.type.tensor_type.shape.dim
        yield value.name, sum(not dim.HasField("dim_value") for dim in dims)
