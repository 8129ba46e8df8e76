"""What a model can be written as, by name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.core import AnyPath, DataError, SpecError, did_you_mean, path_of

if TYPE_CHECKING:
    from hil.estimators import RobotEstimator
    from hil.export.exported import Exported

TARGETS = {
    "c": ("hil.export.c", "export_c"),
    "urdf": ("hil.export.urdf", "export_urdf"),
    "onnx": ("hil.export.onnx_export", "export_onnx"),
    "torch": ("hil.export.torch_export", "export_torch"),
    "onnx-mlp": ("hil.export.onnx_mlp", "export_onnx_mlp"),
    "json": ("hil.export.json_export", "export_json"),
}
"""Name → module and function; imported when it is asked for, as some need heavy libraries."""

ENDINGS = {
    "c": "", "urdf": ".urdf", "onnx": ".onnx", "torch": ".pt2", "onnx-mlp": ".onnx", "json": ".json"
}  # fmt: skip
"""Of the file's name; C is a folder."""

FOREIGN = {".c", ".h", ".cc", ".cpp", ".zip", ".pt", ".yaml", *filter(None, ENDINGS.values())}
"""Endings that promise something; any other may stand for anything."""

DAMAGED = (ValueError, TypeError, ArithmeticError, LookupError)
"""What numbers that cannot be make arithmetic raise."""

OPTIONS = {"c": ("prefix", "unchecked"), "urdf": ("unchecked",)}
"""What else a target takes."""


def export_model(
    model: AnyPath,
    out: AnyPath,
    *,
    to: str = "c",
    prefix: str | None = None,
    unchecked: bool | None = None,
) -> Exported:
    """Write a saved model for other programs, compared with the model in Python first.

    Args:
        model: Its folder.
        out: The file or folder to be made.
        to: `c` and the other targets of `hil.export.targets`.
        prefix: What files and symbols of C begin with; by default `hil`.
        unchecked: Write C without a compiler to check it with, or a URDF however far off it is.

    Raises:
        DataError: The model cannot be read.
        FitError: It is of a kind that cannot be written so, or what was written does not agree.
        PluginError: Something it takes is not installed, such as a C compiler or cvxpy.
        RecordingError: The file or folder exists already.
        SpecError: There is no such target, or an option is none of it.
    """
    from hil.estimators import load_model_file

    given = {"prefix": prefix, "unchecked": unchecked}
    return written_as(load_model_file(path_of(model)), path_of(out), to, **given)


def written_as(model: RobotEstimator, out: Path, to: str, **options: Any) -> Exported:
    """Write a fitted model as one of `TARGETS`.

    Args:
        model: Fitted.
        out: File or folder to be made.
        to: Name of the target.
        options: Those of `OPTIONS`, where they are not None or False.

    Raises:
        SpecError: There is no such target, it has no such option, or `out` ends as another's file.
        DataError: Numbers of the model are damaged.
        FitError: The model is of a kind that it cannot be, or what it would be does not agree.
        PluginError: What it takes to write or check it is not installed.
        RecordingError: It exists already, or cannot be written.
    """
    if to not in TARGETS:
        raise SpecError(f"--to is {to!r}", hint=did_you_mean(to, TARGETS))
    given = {
        name: value for name, value in options.items() if value is not None and value is not False
    }
    if strange := sorted(set(given) - set(OPTIONS.get(to, ()))):
        raise SpecError(f"--to {to} has no option --{strange[0]}", hint="leave it out")
    _require_ending(out, to)
    module, name = TARGETS[to]
    export = getattr(import_module(module), name)
    try:
        written: Exported = export(model, out, **given)
    except DAMAGED as error:
        raise DataError(
            f"{model.estimator} cannot be written as {to}: {error}",
            hint="its numbers are damaged, or this is a fault of hil's export: evaluate the "
            "model, fit it again, and report it with the model's folder if it says what it should",
        ) from error
    return written


def _require_ending(out: Path, to: str) -> None:
    ending, found = ENDINGS[to], out.suffix.lower()
    if found == ending or found not in FOREIGN:
        return
    what = f"a file that ends with {ending}" if ending else "a folder"
    fitting = next((name for name, of in ENDINGS.items() if of == found), None)
    other = f", or with --to {fitting}" if fitting else ""
    raise SpecError(
        f"--to {to} makes {what}, but --out is {out}",
        hint=f"for example: --out {out.with_suffix(ending)}{other}",
    )
