"""A fitted model as a folder of C: header, source, self-test and CMake file."""

from __future__ import annotations

import tempfile
from pathlib import Path

from hil.estimators import RobotEstimator
from hil.export.c_build import built, require_compiler, self_tested
from hil.export.c_program import CSource, c_source
from hil.export.c_size import size_note
from hil.export.c_test import cmake, self_test
from hil.export.exported import Exported, effort_unit, require_new, write_folder
from hil.export.golden import golden_of
from hil.export.reading import program_of


def export_c(
    model: RobotEstimator, out: Path, *, prefix: str = "hil", unchecked: bool = False
) -> Exported:
    """Write a model as C, after its self-test has passed in a folder of its own.

    Args:
        model: Fitted.
        out: Folder to be made.
        prefix: What files and symbols begin with.
        unchecked: Write it although there is no compiler to check it with.

    Raises:
        FitError: The model is of a kind that is not exported, or the program does not agree.
        PluginError: There is no C compiler.
        RecordingError: The folder exists already, or cannot be made.
        SpecError: The prefix cannot be one.
    """
    require_new(out)
    if not unchecked:
        require_compiler()
    program = program_of(model)
    source = c_source(program, prefix, f"{program.estimator} of {Path(model.robot_.name).name}")
    files = {
        f"{prefix}.h": source.header,
        f"{prefix}.c": source.source,
        f"{prefix}_test.c": self_test(source, program, golden_of(model)),
        "CMakeLists.txt": cmake(source),
    }
    checked, notes = ("", ()) if unchecked else _checked(files, source)
    write_folder(files, out)
    memory = "with" if program.remembers else "without"
    parts = f"{program.estimator}, {memory} memory"
    unit = effort_unit(program.effort_kind)
    return Exported(out, tuple(files), program.joint_names, unit, parts, checked, notes)


def _checked(files: dict[str, str], source: CSource) -> tuple[str, tuple[str, ...]]:
    """What the self-test says, and what a task that calls the program has to have."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, "utf-8")
        names = (f"{source.prefix}.c", f"{source.prefix}_test.c")
        said, _, state = self_tested(folder, built(folder, names, "self_test")).partition("\n")
        return f"self-test: {said}", (size_note(folder, source.prefix, state),)
