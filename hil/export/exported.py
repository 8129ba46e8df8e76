"""What every export says of itself, and writing that leaves all or nothing."""

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
    """What was written.

    Attributes:
        out: The file or folder.
        files: In the folder; the file's own name where it is one.
        joint_names: Order of all arrays.
        effort_unit: Of what comes out; empty where that is no effort.
        parts: Estimator and whether it remembers, for people.
        checked: How well it agrees with the model in Python; empty if that was not looked at.
        notes: For people.
    """

    out: Path
    files: tuple[str, ...]
    joint_names: tuple[str, ...]
    effort_unit: str
    parts: str
    checked: str
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil export --json`; URDF says more."""
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
    """`A` of a current, `N·m` of a torque."""
    return "A" if effort_kind == "current" else "N·m"


def require_new(out: Path) -> None:
    """Refuse to write over anything.

    Raises:
        RecordingError: It exists, or cannot.
    """
    try:
        there = out.exists() or out.is_symlink()  # a link to nothing is written over, too
    except OSError as error:
        raise RecordingError(
            f"cannot write {out}: {error.strerror}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error
    if there:
        raise RecordingError(f"{out} exists already", hint="name one with --out that does not")


def write_folder(files: Mapping[str, str], out: Path) -> None:
    """All or nothing: the folder appears when everything is in it.

    Raises:
        RecordingError: It cannot be made.
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
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def write_file(content: bytes, out: Path) -> None:
    """All or nothing: the file appears when everything is in it.

    Raises:
        RecordingError: It cannot be made.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, content)
    except OSError as error:
        raise RecordingError(
            f"cannot write {out}: {error.strerror}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error
