"""Programs in C: built by any compiler, run, and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.export.c import PARTS, CSource
from hil.export.c_compiler import STRICT

COMPILERS = ("gcc", "clang")
SANITIZED = (
    "-g", "-O0", "-fno-sanitize-recover=all",  # -O1 takes ten times as long
    "-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow",
)  # fmt: skip
TEXTS = Path(__file__).with_name("c")
"""Programs that call one: `odd_numbers.c`, `stack.c`."""

SHIM = """#include "hil.h"
#include <stddef.h>
size_t hil_state_size(void);
size_t hil_state_size(void) { return sizeof(hil_state); }
"""


def compiled(compiler: str, arguments: Sequence[str | Path], folder: Path) -> None:
    """Run a compiler; the test is skipped without it, and fails if it refuses."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    command = [compiler, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:3000]


def require_sanitizers(compiler: str, folder: Path) -> None:
    """Skip the test if the compiler cannot link them."""
    (folder / "empty.c").write_text("int main(void) { return 0; }\n")
    try:
        compiled(compiler, [*SANITIZED, "empty.c", "-o", "empty"], folder)
    except AssertionError:
        pytest.skip(f"{compiler} has no address and undefined behaviour sanitizers")


def written(source: CSource, folder: Path) -> Path:
    """Write `hil.h` and `hil.c` into `folder` and return it."""
    (folder / "hil.h").write_text(source.header, "utf-8")
    (folder / "hil.c").write_text(source.source, "utf-8")
    return folder


class Build:
    """A program, compiled once without a warning, to be linked with any number of callers.

    Args:
        source: Folder with hil.h and hil.c.
        out: Folder to build in.
        compiler: Its name.
        flags: Of optimisation and the like.
    """

    def __init__(
        self, source: Path, out: Path, compiler: str = "cc", flags: Sequence[str] = ("-O1",)
    ) -> None:
        self.source, self.out, self._compiler, self._flags = source, out, compiler, flags
        compile_only = [*STRICT, *flags, "-fPIC", "-c", source / "hil.c", "-o", "hil.o"]
        compiled(compiler, compile_only, out)

    def ran(self, main: Path, passes: bool = True) -> str:
        """What a caller with `main` prints."""
        program = self.out / main.stem
        flags = ("-std=gnu11", *self._flags, "-pthread", f"-I{self.source}")
        compiled(self._compiler, [*flags, main, "hil.o", "-lm", "-o", program], self.out)
        environment = {"LD_BIND_NOW": "1"}  # a first call is as deep as any
        done = subprocess.run([program], capture_output=True, text=True, env=environment)
        assert (done.returncode == 0) == passes, (done.returncode, done.stdout, done.stderr)
        return done.stdout

    def self_test(self) -> str:
        """What the self-test beside the program prints."""
        return self.ran(self.source / "hil_test.c")

    def library(self, n: int) -> Library:
        """The program of an arm with n joints, to be called."""
        (self.out / "shim.c").write_text(SHIM)
        command = ["-shared", "-fPIC", f"-I{self.source}", "shim.c", "hil.o", "-lm"]
        compiled(self._compiler, [*command, "-o", "hil.so"], self.out)
        return Library(self.out / "hil.so", n)


Pointer = ctypes.c_void_p


def _at(values: FloatArray) -> Pointer:
    return Pointer(values.ctypes.data)


class Library:
    """One stream of a program in C.

    Attributes:
        parts: (7, n) of the newest effort, in the order of `hil.export.c.PARTS`.
    """

    def __init__(self, path: Path, n: int) -> None:
        self._c = ctypes.CDLL(str(path))
        self._c.hil_state_size.restype = ctypes.c_size_t
        self._c.hil_set_load.argtypes = [Pointer, ctypes.c_double, Pointer, Pointer]
        self._c.hil_reset.restype = None
        self._state = np.zeros(self._c.hil_state_size() // 8 + 1)
        self._effort, self.parts = np.zeros(n), np.zeros((len(PARTS), n))
        self.reset()

    def reset(self) -> None:
        self._c.hil_reset(_at(self._state))

    def mount(self, load: Payload) -> int:
        """What `hil_set_load` returns."""
        com, inertia = np.array(load.com), np.array(load.inertia)
        found: int = self._c.hil_set_load(_at(self._state), load.mass, _at(com), _at(inertia))
        return found

    def warm(self, kelvin: FloatArray) -> int:
        """What `hil_set_warmth` returns."""
        found: int = self._c.hil_set_warmth(_at(self._state), _at(kelvin))
        return found

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(n,) effort of a sample; unchanged if the sample is refused."""
        rows = [np.array(row, dtype=float) for row in (q, qd, qdd)]
        places = [_at(row) for row in (*rows, self._effort, self.parts)]
        self._c.hil_step(_at(self._state), *places)
        return self._effort.copy()
