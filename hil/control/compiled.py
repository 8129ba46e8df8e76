"""The C program of a model inside Python: compiled when asked for, called through ctypes."""

from __future__ import annotations

import ctypes
import shlex
import tempfile
from pathlib import Path

import numpy as np

from hil.arms import Payload
from hil.control.sample import HINT, REFUSED, as_sample
from hil.core import DataError, FitError, FloatArray, PluginError
from hil.estimators import RobotEstimator
from hil.export import (
    LOAD,
    PARTS,
    Program,
    built,
    c_source,
    closeness,
    golden_of,
    program_of,
    require_compiler,
)

FAST = ("-O3", "-march=native", "-fPIC", "-shared")

SHIM = """#include "hil.h"
#include <stddef.h>
size_t hil_state_size(void);
size_t hil_state_size(void) { return sizeof(hil_state); }
"""

Pointer = ctypes.c_void_p
Plain, DOUBLE = np.ndarray, np.dtype(np.float64)

SAMPLES = 60
"""Compared with the model's own stream, without and with a load, before anything is said."""


class CompiledProgram:
    """One stream of a model, as machine code.

    Nothing is allocated by `step`: inputs are copied into, and efforts read from, arrays that are
    there from the start.

    Args:
        model: Fitted.

    Attributes:
        effort: (n,) of the newest sample; overwritten by the next.
        parts: By name, (n,) parts of it after a step with `explain`; they add up to it.

    Raises:
        NotExported: The model is of a kind that is not exported.
        FitError: It does not compile, or does not say what the model says.
        PluginError: There is no C compiler, or none for this machine.
    """

    def __init__(self, model: RobotEstimator) -> None:
        program = program_of(model)
        n = program.n
        self._library = _loaded(program)
        self._state = np.zeros(self._library.hil_state_size() // 8 + 1)
        self._inputs = np.zeros((3, n))
        self.effort: FloatArray = np.zeros(n)
        self._parts = np.zeros((len(PARTS), n))
        self.parts = dict(zip(PARTS, self._parts, strict=True))
        self._where = Pointer(self._state.ctypes.data)
        motion = [Pointer(row.ctypes.data) for row in self._inputs]
        out = Pointer(self.effort.ctypes.data)
        self._call = (self._where, *motion, out, Pointer(None))
        self._explained = (self._where, *motion, out, Pointer(self._parts.ctypes.data))
        self._shape = (n,)
        self._require_agreement(model, program)
        self.reset()

    def reset(self) -> None:
        """Begin afresh with the next sample, without a load."""
        self._library.hil_reset(self._where)

    def mount(self, payload: Payload) -> None:
        """Carry a load from the next sample on.

        Raises:
            DataError: It is none.
        """
        com, inertia = np.array(payload.com), np.array(payload.inertia)
        places = Pointer(com.ctypes.data), Pointer(inertia.ctypes.data)
        if self._library.hil_set_load(self._where, ctypes.c_double(payload.mass), *places):
            raise DataError(f"{payload} is no load", hint="give finite numbers, and a mass ≥ 0")

    def step(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray, *, explain: bool = False
    ) -> FloatArray:
        """`effort` (n,) of one sample, each input (n,).

        Raises:
            DataError: An input is not one finite number per joint.
        """
        plain = isinstance(q, Plain) and isinstance(qd, Plain) and isinstance(qdd, Plain)
        if not (plain and q.dtype == qd.dtype == qdd.dtype == DOUBLE) or not (
            q.shape == qd.shape == qdd.shape == self._shape
        ):
            q, qd, qdd = as_sample(self._shape[0], q, qd, qdd)
        self._inputs[0], self._inputs[1], self._inputs[2] = q, qd, qdd
        if self._library.hil_step(*(self._explained if explain else self._call)):
            raise DataError(REFUSED, hint=HINT)
        return self.effort

    def _require_agreement(self, model: RobotEstimator, program: Program) -> None:
        """Optimised for this machine: what the portable program says proves nothing of it."""
        golden = golden_of(model, SAMPLES)
        limits = closeness(program, golden)
        for k, (load, wanted) in enumerate(((Payload(), golden.bare), (LOAD, golden.loaded))):
            self.reset()
            self.mount(load)
            rows = zip(golden.q, golden.qd, golden.qdd, wanted, strict=True)
            for i, (q, qd, qdd, effort) in enumerate(rows):
                added = 0.0 if golden.residuals is None else golden.residuals[k, i]
                off = self.step(q, qd, qdd, explain=True) - self.parts["residual"]
                off = np.abs(off - (effort - added))
                learned = np.abs(self.parts["residual"] - added)
                if not (np.all(off <= limits.effort) and np.all(learned <= limits.residual)):
                    raise FitError(
                        "the compiled program does not agree with the model: off by up to "
                        f"{np.max((off + learned) / limits.largest):.1e} of a joint's largest "
                        "effort",
                        hint="take Predictor(…, compiled=False), and report this with the "
                        "model's folder and the compiler's version",
                    )


def _loaded(program: Program) -> ctypes.CDLL:
    """The library; its file may go once it is mapped."""
    source = c_source(program)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in (("hil.h", source.header), ("hil.c", source.source), ("shim.c", SHIM)):
            (folder / file).write_text(text, "utf-8")
        made = built(folder, ("hil.c", "shim.c"), "hil.so", FAST)
        try:
            library = ctypes.CDLL(str(made))
        except OSError as error:
            raise PluginError(
                f"what {shlex.join(require_compiler())} made cannot be loaded: {error}",
                hint="name a C compiler for this machine with CC=…, or take compiled=False",
            ) from error
    library.hil_state_size.restype = ctypes.c_size_t
    library.hil_reset.argtypes = [Pointer]
    library.hil_reset.restype = None
    library.hil_set_load.argtypes = [Pointer, ctypes.c_double, Pointer, Pointer]
    library.hil_step.argtypes = [Pointer] * 6
    return library
