"""The same model in runtimes for networks: torch as it is, torch compiled, onnxruntime; one thread.

Each is called as a controller would: one sample of numpy arrays in, the state fed back, an array
out. What it takes to make tensors of arrays is part of the time.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.prediction.clock import timed, told
from hil.arms.payload import Payload
from hil.core.errors import FitError
from hil.core.typing import FloatArray
from hil.estimators.base import RobotEstimator
from hil.export.agreement import Step, golden_of, largest_difference, load_row

if TYPE_CHECKING:
    from hil.export.torch_modules import TorchModel

ONNX = ("onnx", "onnxscript", "onnxruntime")
TOO_SLOW = "it takes long to write or to compile; left out of --quick"


def timed_runtimes(
    name: str, model: RobotEstimator, calls: int, quick: bool
) -> tuple[dict[str, float], dict[str, str]]:
    """Measure times and deviations by runtime; list the skipped runtimes with reasons."""
    import torch

    from hil.export.torch_modules import module_of

    try:
        traced = module_of(model)
    except FitError as error:
        return {}, {f"{name}_{how}": error.message for how in ("torch", "onnxruntime")}
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        figures, skipped = {}, {}
        golden = golden_of(model)
        for how, step in _steps(traced, quick):
            label = f"{name}_{how}"
            if isinstance(step, str):
                skipped[label] = step
                continue
            figures[f"{label}_off_by"] = largest_difference(step, golden, traced.state_size)
            stream = _streaming(step, traced.state_size)
            figures |= told(label, timed(stream, model.robot_, calls))
    finally:
        torch.set_num_threads(before)
    return figures, skipped


def _steps(traced: TorchModel, quick: bool) -> Iterator[tuple[str, Step | str]]:
    """Contestants by name, each made when its turn comes, or why it is left out."""
    import torch

    if missing := [library for library in ONNX if find_spec(library) is None]:
        yield "onnxruntime", f"{missing[0]} is not installed"
    elif quick and traced.rate_hz is not None:  # convolutions make the larger graph
        yield "onnxruntime", TOO_SLOW
    else:
        from hil.export.onnx_export import graph, loaded

        content = graph(traced)
        yield "onnxruntime", loaded(content)
        yield "onnxruntime_bound", _bound(content)
    yield "torch", _in_torch(traced.module)
    if quick:
        yield "torch_compiled", TOO_SLOW
    elif shutil.which("g++") is None:
        yield "torch_compiled", "there is no g++, which torch.compile calls"
    else:
        yield "torch_compiled", _in_torch(torch.compile(traced.module, dynamic=False))


def _bound(content: bytes) -> Step:
    """Onnxruntime without allocation: what it reads and writes stays where it is."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def held(value: Any) -> Any:
        shape = [size if isinstance(size, int) else 1 for size in value.shape]
        return ort.OrtValue.ortvalue_from_numpy(np.zeros(shape))

    binding = session.io_binding()
    taken = [(one.name, held(one)) for one in session.get_inputs()]
    given = [(one.name, held(one)) for one in session.get_outputs()]
    for name, value in taken:
        binding.bind_ortvalue_input(name, value)
    for name, value in given:
        binding.bind_ortvalue_output(name, value)

    def step(inputs: Sequence[FloatArray]) -> Sequence[FloatArray]:
        for (_, value), row in zip(taken, inputs, strict=True):
            value.update_inplace(np.ascontiguousarray(row))
        session.run_with_iobinding(binding)
        return [value.numpy().copy() for _, value in given]

    return step


def _in_torch(module: Callable[..., Any]) -> Step:
    import torch

    def step(inputs: Sequence[FloatArray]) -> Sequence[FloatArray]:
        with torch.inference_mode(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            given = module(*(torch.from_numpy(one) for one in inputs))
        return [one.numpy() for one in given]

    return step


def _streaming(step: Step, state_size: int) -> Callable[..., FloatArray]:
    """One sample (n,) each of q, qd, qdd in, the effort out; it remembers."""
    load = load_row(Payload())
    state = [np.zeros((1, state_size))] if state_size else []

    def sample(q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        effort, *after = step([q[None], qd[None], qdd[None], load, *state])
        state[:] = after
        found: FloatArray = effort[0]
        return found

    return sample
