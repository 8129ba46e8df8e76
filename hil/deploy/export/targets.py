"""What a model can be written as, by name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hil.errors import SpecError

if TYPE_CHECKING:
    from hil.identify.base import RobotEstimator

TARGETS = {
    "c": ("hil.deploy.export.c_export", "export_c"),
    "urdf": ("hil.deploy.identified_urdf", "export_urdf"),
    "onnx": ("hil.deploy.export.onnx_export", "export_onnx"),
    "torch": ("hil.deploy.export.torch_export", "export_torch"),
    "onnx-mlp": ("hil.deploy.export.mlp_export", "export_onnx_mlp"),
    "json": ("hil.deploy.export.json_export", "export_json"),
}
"""Name → module and function; imported when it is asked for, as some need heavy libraries."""

OPTIONS = {"c": ("prefix", "unchecked")}
"""What else a target takes."""


class Written(Protocol):
    """What an export returns."""

    @property
    def out(self) -> Path:
        """The file or folder that was made."""

    def to_dict(self) -> dict[str, Any]:
        """For `--json`."""


def export_model(model: RobotEstimator, out: Path, to: str, **options: Any) -> Written:
    """Write a fitted model as one of `TARGETS`.

    Args:
        model: Fitted.
        out: File or folder to be made.
        to: Name of the target.
        options: Those of `OPTIONS`, where they are not None.

    Raises:
        SpecError: There is no such target, or it has no such option.
        FitError: The model is of a kind that it cannot be, or what it would be does not agree.
        PluginError: What it takes to write or check it is not installed.
        RecordingError: It exists already, or cannot be written.
    """
    if to not in TARGETS:
        raise SpecError(f"--to is {to!r}", hint=f"a model is written as {', '.join(TARGETS)}")
    given = {name: value for name, value in options.items() if value is not None}
    if strange := sorted(set(given) - set(OPTIONS.get(to, ()))):
        raise SpecError(f"--to {to} has no option --{strange[0]}", hint="leave it out")
    module, name = TARGETS[to]
    written: Written = getattr(import_module(module), name)(model, out, **given)
    return written
