"""Export of a fitted model as one `.pt2` file for PyTorch, with a traced graph and no code.

The PyTorch modules of the export are in `hil.export.torch_modules`, which imports PyTorch.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import FitError, FloatArray, plugins
from hil.estimators import RobotEstimator
from hil.export.agreement import Step, golden_of, require_agreement
from hil.export.exported import Exported, effort_unit, require_new, write_file

if TYPE_CHECKING:
    from hil.export.torch_modules import TorchModel


TOLD = "hil.json"
"""Name of the file in the archive that describes how to call the program."""


def export_torch(model: RobotEstimator, out: Path) -> Exported:
    """Write a model as a PyTorch program, after reading the program back and comparing it.

    Args:
        model: Fitted model.
        out: File that is created, usually with the extension `.pt2`.

    Raises:
        FitError: The estimator cannot be exported, or the program does not agree with the model.
        PluginError: PyTorch is not installed.
        RecordingError: The file already exists, or cannot be created.
    """
    require_new(out)
    if find_spec("torch") is None:
        raise plugins.not_installed("--to torch", ["torch"], "learn")
    from hil.export.torch_modules import module_of

    traced = module_of(model)
    content = archive(traced)
    checked = require_agreement(
        loaded(content), golden_of(model), traced.state_size, "the PyTorch program"
    )
    write_file(content, out)
    warns = (
        ()
        if out.suffix == ".pt2"
        else ("torch.export.load warns about file names other than *.pt2",)
    )
    return told_of(traced, out, checked, *warns)


def told_of(traced: TorchModel, out: Path, checked: str, *notes: str) -> Exported:
    """Return the result of an export of the passed model to a file."""
    memory = f"with memory of {traced.state_size} numbers" if traced.state else "without memory"
    return Exported(
        out=out,
        files=(out.name,),
        joint_names=traced.joint_names,
        effort_unit=effort_unit(traced.effort_kind),
        parts=f"{traced.estimator}, {memory}",
        checked=checked,
        notes=(*notes, *notes_of(traced)),
    )


def notes_of(traced: TorchModel) -> tuple[str, ...]:
    """Return notes on the sample rate and the units for callers of the program."""
    notes = []
    if traced.rate_hz is not None:
        notes.append(f"the memory of its network is in samples: call it at {traced.rate_hz:.6g} Hz")
    if sliding := [
        name for name, turns in zip(traced.joint_names, traced.turns, strict=True) if not turns
    ]:
        efforts = "" if traced.effort_kind == "current" else ", efforts in N"
        notes.append(f"prismatic joints: {', '.join(sliding)}; positions in m{efforts}")
    return tuple(notes)


def archive(traced: TorchModel) -> bytes:
    """Return the content of the `.pt2` file.

    Raises:
        FitError: PyTorch would write a pickle into the file.
    """
    import torch

    inputs = example_inputs(traced, 2)
    rows = torch.export.Dim("rows", min=1)
    with torch.no_grad():
        program = torch.export.export(
            traced.module, inputs, dynamic_shapes=tuple({0: rows} for _ in inputs)
        )
    # The example inputs would be the only pickle in the archive.
    program.example_inputs = None
    content = io.BytesIO()
    torch.export.save(program, content, extra_files={TOLD: json.dumps(traced.metadata(), indent=1)})
    if pickled := pickles(content.getvalue()):
        raise FitError(
            f"torch {torch.__version__} would write pickles: {', '.join(pickled)}",
            hint="use the version of torch in constraints.txt",
        )
    return content.getvalue()


def example_inputs(traced: TorchModel, rows: int) -> tuple[Any, ...]:
    """Return inputs q, qd, qdd, load[, state] that are zero, with the passed number of rows."""
    import torch

    sizes = [traced.n] * 3 + [10] + [traced.state_size] * bool(traced.state)
    return tuple(torch.zeros(rows, size, dtype=torch.float64) for size in sizes)


def pickles(content: bytes) -> list[str]:
    """Return the names of those files in an archive that are pickles."""
    with zipfile.ZipFile(io.BytesIO(content)) as kept:
        return [
            name
            for name in kept.namelist()
            # Either a pickle, or an archive of torch.save that contains one.
            if (head := kept.read(name)[:4])[:2] in (b"\x80\x02", b"\x80\x04", b"\x80\x05")
            or head == b"PK\x03\x04"
        ]


def loaded(content: bytes) -> Step:
    """Return the program after reading it back from the content of a file."""
    import torch

    program = torch.export.load(io.BytesIO(content)).module()

    def step(inputs: Sequence[FloatArray]) -> Sequence[FloatArray]:
        with torch.no_grad():
            return [found.numpy() for found in program(*(torch.tensor(one) for one in inputs))]

    return step
