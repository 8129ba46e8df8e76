"""ONNX graphs are what small runtimes take; nothing else is written."""

from __future__ import annotations

import pytest

onnx = pytest.importorskip("onnx", reason="onnx is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from onnx import TensorProto, helper  # noqa: E402

from hil.core.errors import FitError  # noqa: E402
from hil.export import onnx_export  # noqa: E402
from hil.export.onnx_export import OPERATORS, require_plain  # noqa: E402


def graph_of(*nodes, more=(), shape=("rows", 3), opset=20, ir=10, constants=()):
    """A graph x → y of these nodes."""
    x = helper.make_tensor_value_info("x", TensorProto.DOUBLE, shape)
    y = helper.make_tensor_value_info("y", TensorProto.DOUBLE, shape)
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(name, 1) for name in more)]
    made = helper.make_graph(nodes, "g", [x], [y], initializer=list(constants))
    return helper.make_model(made, opset_imports=opsets, ir_version=ir)


def test_a_graph_with_what_they_lack_is_refused() -> None:
    sine = helper.make_node("Sin", ["x"], ["y"])
    require_plain(graph_of(sine))
    inner = helper.make_graph(
        [helper.make_node("GatherElements", ["x", "i"], ["z"])], "inner", [], []
    )
    hidden = helper.make_node("Foo", ["x"], ["y"], then_branch=inner)
    with pytest.raises(FitError, match="do not support: Foo, GatherElements"):
        require_plain(graph_of(hidden))
    with pytest.raises(FitError, match=r"do not support: ai\.onnx\.ml"):
        require_plain(graph_of(sine, more=["ai.onnx.ml"]))


SINE = helper.make_node("Sin", ["x"], ["y"])
SUMMED = [
    helper.make_node("ReduceSum", ["e"], ["s"], keepdims=0),
    helper.make_node("Add", ["x", "s"], ["y"]),
]


@pytest.mark.parametrize("shape", [(3, "rows"), ("rows", "more"), ("batch", 3), (2, 3), (None, 3)])
def test_nothing_but_leading_rows_may_be_open(shape) -> None:
    with pytest.raises(FitError, match="not fixed: x, y"):
        require_plain(graph_of(SINE, shape=shape))


def test_formats_that_are_too_new_are_refused() -> None:
    require_plain(graph_of(SINE, opset=21))
    with pytest.raises(FitError, match="do not support: opset 23"):
        require_plain(graph_of(SINE, opset=23))
    with pytest.raises(FitError, match="do not support: format 11"):
        require_plain(graph_of(SINE, ir=11))


@pytest.mark.parametrize("known", [False, True], ids=["unknown", "as if it were known"])
@pytest.mark.parametrize("name", ["Expand", "Unique"])
def test_shapes_that_data_make_are_refused(name, known, monkeypatch) -> None:
    """The operators are not among those that may be; and if they were, the shape would tell."""
    if known:
        more = OPERATORS | {"Expand", "Unique", "ReduceMax"}
        monkeypatch.setattr(onnx_export, "OPERATORS", more)
    size = [
        helper.make_node("Cast", ["x"], ["i"], to=TensorProto.INT64),
        helper.make_node("ReduceMax", ["i"], ["k"], keepdims=0),
        helper.make_node("Unsqueeze", ["k", "axis"], ["kk"]),
        helper.make_node("Expand", ["one", "kk"], ["e"]),
    ]
    made = size if name == "Expand" else [helper.make_node("Unique", ["x"], ["e"])]
    constants = [
        helper.make_tensor("axis", TensorProto.INT64, [1], [0]),
        helper.make_tensor("one", TensorProto.DOUBLE, [1], [1.0]),
    ]
    words = "not fixed: e" if known else f"do not support: .*{name}"
    with pytest.raises(FitError, match=words):
        require_plain(graph_of(*made, *SUMMED, constants=constants))


def test_graphs_that_are_not_valid_are_one_error() -> None:
    with pytest.raises(FitError, match="graph is not valid: "):
        require_plain(graph_of(helper.make_node("Sin", ["nowhere"], ["y"])))
    narrow = helper.make_tensor("w", TensorProto.DOUBLE, [2, 2], [0.0] * 4)
    with pytest.raises(FitError, match="graph is not valid: "):
        require_plain(graph_of(helper.make_node("MatMul", ["x", "w"], ["y"]), constants=[narrow]))
