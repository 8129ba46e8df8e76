"""A fitted model as one ONNX file: the module of `torch_model`, traced into standard operators."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import FloatArray, plugins
from hil.estimators import RobotEstimator
from hil.export.agreement import Step, require_agreement
from hil.export.exported import Exported, require_new, write_file
from hil.export.golden import golden_of
from hil.export.torch_export import example_inputs, told_of

if TYPE_CHECKING:
    from hil.export.torch_model import TorchModel

OPSET = 20
"""TF3820 takes 21 at most."""

NEEDED = ("torch", "onnx", "onnxscript", "onnxruntime")
"""Of the extra `onnx`: to trace, to write, to check."""


def export_onnx(model: RobotEstimator, out: Path) -> Exported:
    """Write a model as ONNX, after onnxruntime has said with it what the model says.

    Args:
        model: Fitted.
        out: File to be made; `.onnx` by custom.

    Raises:
        FitError: The model is of a kind that is not exported, or the graph does not agree, or is
            not what small runtimes take.
        PluginError: Something of the extra `onnx` is not installed.
        RecordingError: The file exists already, or cannot be made.
    """
    require_new(out)
    require_onnx()
    from hil.export.torch_model import module_of

    traced = module_of(model)
    content = graph(traced)
    checked = require_agreement(
        loaded(content), golden_of(model), traced.state_size, "the ONNX graph"
    )
    write_file(content, out)
    return told_of(traced, out, checked, f"opset {OPSET}, {nodes(content)} nodes")


def require_onnx() -> None:
    """Refuse without what it takes.

    Raises:
        PluginError: The extra `onnx` is missing, or part of it.
    """
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise plugins.not_installed("--to onnx", missing, "onnx")


def graph(traced: TorchModel) -> bytes:
    """The file's content: opset 20, static shapes but for the leading rows.

    Raises:
        FitError: It has operators or shapes that small runtimes lack.
    """
    import torch

    from hil.export.onnx_graph import cleaned, require_plain

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
    found = cleaned(written.model_proto, traced.told())
    require_plain(found)
    content: bytes = found.SerializeToString()
    return content


def nodes(content: bytes) -> int:
    """How many operations the graph has."""
    import onnx

    return len(onnx.load_from_string(content).graph.node)


def loaded(content: bytes) -> Step:
    """The graph under onnxruntime, on one thread of the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]

    def step(inputs: Sequence[FloatArray]) -> Sequence[FloatArray]:
        found: list[FloatArray] = session.run(None, dict(zip(names, inputs, strict=True)))
        return found

    return step


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the tracer's word on torchvision and on its own deprecations."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
