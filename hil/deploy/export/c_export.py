"""A fitted model as a folder of C: header, source, self-test and CMake file."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.deploy.export.c_build import built, require_compiler, self_tested
from hil.deploy.export.c_program import CSource, c_source
from hil.deploy.export.c_test import cmake, self_test
from hil.deploy.export.golden import golden_of
from hil.deploy.export.reading import program_of
from hil.errors import RecordingError
from hil.identify.base import RobotEstimator


@dataclass(frozen=True, slots=True)
class CExport:
    """What was written.

    Attributes:
        out: The folder.
        files: In it.
        joint_names: Order of all arrays.
        effort_unit: Of what comes out.
        parts: Estimator and whether it remembers, for people.
        checked: What the self-test said; empty if it was not run.
    """

    out: Path
    files: tuple[str, ...]
    joint_names: tuple[str, ...]
    effort_unit: str
    parts: str
    checked: str

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil export --to c --json`."""
        return {
            "out": str(self.out),
            "files": list(self.files),
            "joint_names": list(self.joint_names),
            "effort_unit": self.effort_unit,
            "parts": self.parts,
            "checked": self.checked,
        }


def export_c(
    model: RobotEstimator, out: Path, *, prefix: str = "hil", unchecked: bool = False
) -> CExport:
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
    if out.exists():
        raise RecordingError(f"{out} exists already", hint="name a folder that is to be made")
    if not unchecked:
        require_compiler()
    program = program_of(model)
    source = c_source(program, prefix, f"{program.estimator} of {model.robot_.name}")
    files = {
        f"{prefix}.h": source.header,
        f"{prefix}.c": source.source,
        f"{prefix}_test.c": self_test(source, golden_of(model)),
        "CMakeLists.txt": cmake(source),
    }
    checked = "" if unchecked else _checked(files, source)
    _write(files, out)
    memory = "with" if program.remembers else "without"
    return CExport(
        out, tuple(files), program.joint_names, "A" if program.effort_kind == "current" else "N·m",
        f"{program.estimator}, {memory} memory", checked,
    )  # fmt: skip


def _checked(files: dict[str, str], source: CSource) -> str:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in files.items():
            (folder / file).write_text(text, "utf-8")
        names = (f"{source.prefix}.c", f"{source.prefix}_test.c")
        return self_tested(folder, built(folder, names, "self_test"))


def _write(files: dict[str, str], out: Path) -> None:
    """All or nothing: the folder appears when everything is in it."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
        try:
            for file, text in files.items():
                (made / file).write_text(text, "utf-8")
            made.chmod(0o755)
            made.rename(out)
        except BaseException:
            shutil.rmtree(made, ignore_errors=True)
            raise
    except OSError as error:
        raise RecordingError(f"cannot write {out}: {error.strerror}") from error
