"""Export formats of fitted models, selected by name."""

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
"""Mapping from format to module and function; modules are imported on use, as some are slow."""

ENDINGS = {
    "c": "", "urdf": ".urdf", "onnx": ".onnx", "torch": ".pt2", "onnx-mlp": ".onnx", "json": ".json"
}  # fmt: skip
"""Mapping from format to file extension; C has no extension, because it is exported as a folder."""

FOREIGN = {".c", ".h", ".cc", ".cpp", ".zip", ".pt", ".yaml", *filter(None, ENDINGS.values())}
"""File extensions of known formats; files with other extensions are accepted for any format."""

DAMAGED = (ValueError, TypeError, ArithmeticError, LookupError)
"""Exceptions that invalid numbers of a model can cause during an export."""

FLAGS = {"unchecked": "--no-check"}
"""Mapping from parameter to command-line option, for options whose names differ."""

OPTIONS = {"c": ("prefix", "unchecked"), "urdf": ("unchecked",)}
"""Names of the additional options of each format."""


def export_model(
    model: AnyPath,
    out: AnyPath,
    *,
    to: str = "c",
    prefix: str | None = None,
    unchecked: bool | None = None,
) -> Exported:
    """Write a saved model for other programs, after comparing it with the Python model.

    Args:
        model: Folder of the model.
        out: File or folder that is created.
        to: Name of the format, such as `c`; one of `hil.export.targets.TARGETS`.
        prefix: Prefix of C files and C symbols; the default is `hil`.
        unchecked: Whether C is written without compiling and testing it, or a URDF is written even
            if it deviates from the model.

    Raises:
        DataError: The model files cannot be read.
        FitError: The estimator does not support the format, or the exported program does not agree
            with the model.
        PluginError: A required program or library, such as a C compiler or cvxpy, is not installed.
        RecordingError: The file or folder already exists.
        SpecError: The format is unknown, or does not have an option that was passed.
    """
    from hil.estimators import load_model_file

    given = {"prefix": prefix, "unchecked": unchecked}
    return written_as(load_model_file(path_of(model)), path_of(out), to, **given)


def written_as(model: RobotEstimator, out: Path, to: str, **options: Any) -> Exported:
    """Write a fitted model in one of the formats of `TARGETS`.

    Args:
        model: Fitted model.
        out: File or folder that is created.
        to: Name of the format.
        options: Mapping of the options in `OPTIONS`; values None and False are ignored.

    Raises:
        SpecError: The format is unknown, does not have the option, or `out` has the extension of a
            different format.
        DataError: Numbers of the model are damaged.
        FitError: The estimator does not support the format, or the exported program does not agree
            with the model.
        PluginError: A program or library for writing or checking the format is not installed.
        RecordingError: The path already exists, or cannot be written.
    """
    if to not in TARGETS:
        raise SpecError(f"unknown format --to {to!r}", hint=did_you_mean(to, TARGETS))
    given = {
        name: value for name, value in options.items() if value is not None and value is not False
    }
    if strange := sorted(set(given) - set(OPTIONS.get(to, ()))):
        option = FLAGS.get(strange[0], f"--{strange[0]}")
        raise SpecError(f"--to {to} has no option {option}", hint=f"remove {option}")
    _require_ending(out, to)
    module, name = TARGETS[to]
    export = getattr(import_module(module), name)
    try:
        written: Exported = export(model, out, **given)
    except DAMAGED as error:
        raise DataError(
            f"{model.estimator} cannot be written as {to}: {error}",
            hint="the numbers of the model are damaged, or hil's export has a fault: evaluate "
            "the model; if its predictions are wrong, fit it again, otherwise report the "
            "fault with the model folder",
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
        f"--to {to} writes {what}, but --out is {out}",
        hint=f"for example: --out {out.with_suffix(ending)}{other}",
    )
