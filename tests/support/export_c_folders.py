"""Programs of the kinds there are, written once, and compilers to build them with."""

from __future__ import annotations

import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest

from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.export.c import export_c
from hil.export.exported import Exported
from hil.export.program import GROUPS
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import nominal

KINDS = ("friction with memory", "residual network", "Lagrangian network")
COMPILERS = ("gcc", "clang")
SANITIZED = (
    "-g", "-O1", "-fno-sanitize-recover=all",
    "-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow",
)  # fmt: skip


@cache
def fitted(kind: str) -> RobotEstimator:
    """One of `KINDS`; not to be changed."""
    if kind == "residual network":
        pytest.importorskip("torch", reason="torch is not installed")
        from tests.support.residual_models import model

        return model()
    if kind == "Lagrangian network":
        pytest.importorskip("torch", reason="torch is not installed")
        from tests.support.lagrangian_models import lagrangian

        return lagrangian("stribeck dahl")
    groups = list(GROUPS)
    memory = estimator("rigid-hysteresis", consistent=False, friction=groups)
    return memory.fit(remembering(1, 2, 3), nominal())


def written(kind: str, folder: Path) -> Exported:
    """The model as C in a folder, which is made once."""
    return export_c(fitted(kind), folder)


def compiled(name: str, folder: Path, out: Path, *flags: str, also: str = "") -> str:
    """What a program of the folder prints, built by the compiler of that name.

    Args:
        name: One of `COMPILERS`; where it is not installed, the test is skipped.
        folder: Holds hil.c.
        out: Where to build.
        flags: Of the compiler.
        also: Text of the file with `main`; by default the self-test.
    """
    if shutil.which(name) is None:
        pytest.skip(f"{name} is not installed")
    main = folder / "hil_test.c"
    if also:
        main = out / "main.c"
        main.write_text(also, "utf-8")
    made = str(out / "made")
    command = [name, *flags, f"-I{folder}", str(main), str(folder / "hil.c"), "-lm", "-o", made]
    if flags == SANITIZED:
        _require_sanitizers(name, out)
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    done = subprocess.run([made], capture_output=True, text=True, env={"LD_BIND_NOW": "1"})
    assert done.returncode == 0, (done.returncode, done.stdout, done.stderr)
    return done.stdout


def _require_sanitizers(name: str, out: Path) -> None:
    empty = out / "empty.c"
    empty.write_text("int main(void) { return 0; }\n")
    command = [name, *SANITIZED, str(empty), "-o", str(out / "empty")]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip(f"{name} has no address and undefined behaviour sanitizers")
