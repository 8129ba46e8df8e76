"""Common result of all exports, and atomic writing of files and folders."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import RecordingError, write_whole


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        out: Path of the written file or folder.
        files: Names of the files in the folder, or the name of the single file.
        joint_names: Order of the joints in all arrays.
        effort_unit: Unit of the effort that the export predicts; empty if the output is not an
            effort.
        parts: Text that names the estimator and states whether the program has memory.
        checked: Text about the agreement with the Python model; empty if the agreement was not
            checked.
        notes: Notes for the operator.
    """

    out: Path
    files: tuple[str, ...]
    joint_names: tuple[str, ...]
    effort_unit: str
    parts: str
    checked: str
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the documented output of `hil export --json`; a URDF export adds fields."""
        return {
            "out": str(self.out),
            "files": list(self.files),
            "joint_names": list(self.joint_names),
            "effort_unit": self.effort_unit,
            "parts": self.parts,
            "checked": self.checked,
            "notes": list(self.notes),
        }


def effort_unit(effort_kind: str) -> str:
    """Return the effort unit: `A` for a current or `N·m` for a torque."""
    return "A" if effort_kind == "current" else "N·m"


def require_new(out: Path) -> None:
    """Raise if a file or folder would be overwritten.

    Raises:
        RecordingError: The path exists, or cannot be accessed.
    """
    try:
        there = out.exists() or out.is_symlink()  # writing would also replace a broken link
    except OSError as error:
        raise RecordingError(
            f"cannot write {out}: {error.strerror}",
            hint="check the permissions of the folder and the free disk space",
        ) from error
    if there:
        raise RecordingError(f"{out} exists already", hint="choose a new path with --out")


def write_folder(files: Mapping[str, str], out: Path) -> None:
    """Write a folder atomically: the folder appears only when all its files are complete.

    Raises:
        RecordingError: The folder cannot be written.
    """
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
        raise RecordingError(
            f"cannot write {out}: {error.strerror}",
            hint="check the permissions of the folder and the free disk space",
        ) from error


def write_file(content: bytes, out: Path) -> None:
    """Write a file atomically: the file appears only when its content is complete.

    Raises:
        RecordingError: The file cannot be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, content)
    except OSError as error:
        raise RecordingError(
            f"cannot write {out}: {error.strerror}",
            hint="check the permissions of the folder and the free disk space",
        ) from error
