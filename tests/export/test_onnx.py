"""Models as ONNX graphs: the same numbers under onnxruntime, and nothing small runtimes lack."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from tests.support.paths import ROOT

pytest.importorskip("torch", reason="torch is not installed")
onnx = pytest.importorskip("onnx", reason="onnx is not installed")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
pytest.importorskip("onnxscript", reason="onnxscript is not installed")

from onnx import TensorProto, helper  # noqa: E402

from hil.core.errors import FitError, PluginError  # noqa: E402
from hil.estimators import estimator  # noqa: E402
from hil.export import onnx_export  # noqa: E402
from hil.export.agreement import LOAD, golden_of, load_row, streamed  # noqa: E402
from hil.export.onnx_export import OPERATORS, export_onnx, loaded, nodes_of, require_plain  # noqa: E402
from tests.support.export_models import KINDS, fitted  # noqa: E402
from tests.support.lagrangian_models import lagrangian  # noqa: E402

PAGE = (ROOT / "docs/how-to/export-onnx-torch.md").read_text("utf-8")

EVERYTHING = "rigid-hysteresis everything"

LARGEST = dict.fromkeys(KINDS, 1e-12) | {"residual": 1e-6}
del LARGEST["rigid-hysteresis"]  # part of everything; each takes seconds to trace


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """By kind, what was written; each once."""
    made = {}

    def of(kind: str):
        if kind not in made:
            made[kind] = export_onnx(fitted(kind), tmp_path_factory.mktemp("onnx") / "model.onnx")
        return made[kind]

    return of


@pytest.mark.thorough
@pytest.mark.parametrize("kind", LARGEST)
def test_onnxruntime_says_what_the_model_says(kind, written) -> None:
    told = written(kind)
    assert float(told.checked.split()[4]) < LARGEST[kind]
    assert told.files == ("model.onnx",)


@pytest.mark.parametrize("kind", ["rigid-wls", EVERYTHING, "residual"])
def test_the_graph_is_what_small_runtimes_take(kind, written) -> None:
    model = onnx.load(written(kind).out)
    require_plain(model)
    used = {node.op_type for node in nodes_of(model.graph)}
    assert not [name for name in used if "Gather" in name or "Scatter" in name]
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 20)]
    assert not model.functions
    for value in (*model.graph.input, *model.graph.output):
        rows, *fixed = value.type.tensor_type.shape.dim
        assert rows.dim_param == "rows"
        assert all(dim.dim_value > 0 for dim in fixed)


def test_the_file_says_how_to_call_it_and_not_where_it_was_made(written) -> None:
    told = written("residual")
    model = onnx.load(told.out)
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert said["estimator"] == "residual"
    assert json.loads(said["joint_names"]) == list(fitted("residual").joint_names_)
    assert said["effort_unit"] == "A"
    assert float(said["rate_hz"]) == pytest.approx(100.0)
    sizes = {
        value.name: value.type.tensor_type.shape.dim[1].dim_value for value in model.graph.input
    }
    assert sizes == {"q": 6, "qd": 6, "qdd": 6, "load": 10, "state": int(said["state_size"])}
    assert sum(size for _, size in json.loads(said["state"])) == int(said["state_size"])
    assert [value.name for value in model.graph.output] == ["effort", "state_next"]
    assert b".py" not in told.out.read_bytes()
    assert "its network counts samples: call it at 100 Hz" in told.notes


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["stribeck dahl", "dissipative"])
def test_lagrangian_networks_become_graphs_too(case, tmp_path) -> None:
    told = export_onnx(lagrangian(case), tmp_path / "model.onnx")
    assert float(told.checked.split()[4]) < 2e-6


def test_without_memory_there_is_no_state(written) -> None:
    graph = onnx.load(written("rigid-wls").out).graph
    assert [value.name for value in graph.input] == ["q", "qd", "qdd", "load"]
    assert [value.name for value in graph.output] == ["effort"]


def test_zeros_begin_again_and_loads_may_change(written) -> None:
    kind = EVERYTHING
    golden = golden_of(fitted(kind), samples=80)
    step = loaded(written(kind).out.read_bytes())
    size = int(written(kind).parts.split()[-2])
    zeros = np.zeros((1, size))
    rows = [[one[None] for one in row] for row in zip(golden.q, golden.qd, golden.qdd, strict=True)]
    state = zeros
    for k, row in enumerate(rows):
        load, wanted = (LOAD, golden.loaded) if k % 9 < 4 else (None, golden.bare)
        mounted = np.zeros((1, 10)) if load is None else load_row(load)
        effort, state = step([*row, mounted, state])
        assert effort[0] == pytest.approx(wanted[k], abs=1e-11)
    again, _ = step([*rows[0], np.zeros((1, 10)), zeros])
    kept, _ = step([*rows[0], np.zeros((1, 10)), state])
    assert again[0] == pytest.approx(golden.bare[0], abs=1e-11)
    assert np.abs(kept - again).max() > 0.01


def test_rows_are_streams_of_their_own(written) -> None:
    step = loaded(written("residual").out.read_bytes())
    golden = golden_of(fitted("residual"), samples=80)
    size = int(written("residual").parts.split()[-2])
    states = np.zeros((2, size))
    found = []
    for k in range(40):
        # The second stream runs the motion, the first the same one backwards.
        pair = [one[[79 - k, k]] for one in (golden.q, golden.qd, golden.qdd)]
        effort, states = step([*pair, np.zeros((2, 10)), states])
        found.append(effort[1])
    alone = streamed(step, golden, np.zeros((1, 10)), size)
    assert np.array(found) == pytest.approx(alone[:40], abs=1e-6)


def graph_of(*nodes, more=(), shape=("rows", 3), opset=20, ir=10, constants=()):
    """A graph x → y of these nodes."""
    x = helper.make_tensor_value_info("x", TensorProto.DOUBLE, shape)
    y = helper.make_tensor_value_info("y", TensorProto.DOUBLE, shape)
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(name, 1) for name in more)]
    made = helper.make_graph(nodes, "g", [x], [y], initializer=list(constants))
    return helper.make_model(made, opset_imports=opsets, ir_version=ir)


@pytest.mark.parametrize("kind", [EVERYTHING, "rigid-wls"])
def test_the_example_of_the_page_runs(kind, written, tmp_path, monkeypatch) -> None:
    (tmp_path / "arm.onnx").write_bytes(written(kind).out.read_bytes())
    monkeypatch.chdir(tmp_path)
    golden = golden_of(fitted(kind), samples=80)
    found = {"samples": zip(golden.q, golden.qd, golden.qdd, strict=True)}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0], found)
    assert found["effort"][0] == pytest.approx(golden.bare[-1], abs=1e-11)


def test_a_graph_with_what_they_lack_is_refused() -> None:
    sine = helper.make_node("Sin", ["x"], ["y"])
    require_plain(graph_of(sine))
    inner = helper.make_graph(
        [helper.make_node("GatherElements", ["x", "i"], ["z"])], "inner", [], []
    )
    hidden = helper.make_node("Foo", ["x"], ["y"], then_branch=inner)
    with pytest.raises(FitError, match="lack: Foo, GatherElements"):
        require_plain(graph_of(hidden))
    with pytest.raises(FitError, match=r"lack: ai\.onnx\.ml"):
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
    with pytest.raises(FitError, match="lack: opset 23"):
        require_plain(graph_of(SINE, opset=23))
    with pytest.raises(FitError, match="lack: format 11"):
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
    words = "not fixed: e" if known else f"lack: .*{name}"
    with pytest.raises(FitError, match=words):
        require_plain(graph_of(*made, *SUMMED, constants=constants))


def test_graphs_that_are_not_valid_are_one_error() -> None:
    with pytest.raises(FitError, match="graph is not valid: "):
        require_plain(graph_of(helper.make_node("Sin", ["nowhere"], ["y"])))
    narrow = helper.make_tensor("w", TensorProto.DOUBLE, [2, 2], [0.0] * 4)
    with pytest.raises(FitError, match="graph is not valid: "):
        require_plain(graph_of(helper.make_node("MatMul", ["x", "w"], ["y"]), constants=[narrow]))


def test_a_graph_that_says_something_else_is_not_written(written, tmp_path, monkeypatch) -> None:
    def bent(content):
        step = honest(content)
        return lambda inputs: [1.001 * one for one in step(inputs)]

    honest, content = onnx_export.loaded, written("rigid-wls").out.read_bytes()
    monkeypatch.setattr(onnx_export, "graph", lambda traced: content)
    monkeypatch.setattr(onnx_export, "loaded", bent)
    with pytest.raises(FitError, match="ONNX graph does not agree with the model: off by 1"):
        export_onnx(fitted("rigid-wls"), tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch) -> None:
    with pytest.raises(FitError, match="static-wls is not fitted"):
        export_onnx(estimator("static-wls"), tmp_path / "model.onnx")
    monkeypatch.setattr(
        onnx_export, "find_spec", lambda name: None if name == "onnxruntime" else name
    )
    with pytest.raises(PluginError, match="needs onnxruntime, which is not installed") as refused:
        export_onnx(fitted("rigid-wls"), tmp_path / "model.onnx")
    assert refused.value.hint == 'pip install "hil[onnx]"'
