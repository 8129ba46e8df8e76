"""The C program of a model inside Python: compiled when asked for, called through ctypes."""

from __future__ import annotations

import ctypes
import tempfile
from pathlib import Path

import numpy as np

from hil.deploy.export.c_build import built
from hil.deploy.export.c_program import PARTS, c_source
from hil.deploy.export.reading import program_of
from hil.errors import DataError
from hil.identify.base import RobotEstimator
from hil.payload import Payload
from hil.typing import FloatArray

FAST = ("-O3", "-march=native", "-fPIC", "-shared")

SHIM = """#include "hil.h"
#include <stddef.h>
size_t hil_state_size(void);
size_t hil_state_size(void) { return sizeof(hil_state); }
"""

Pointer = ctypes.c_void_p


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
        FitError: The model is of a kind that is not exported, or does not compile.
        PluginError: There is no C compiler.
    """

    def __init__(self, model: RobotEstimator) -> None:
        program = program_of(model)
        n = program.n
        self._library = _loaded(model)
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
        try:
            self._inputs[0], self._inputs[1], self._inputs[2] = q, qd, qdd
        except (TypeError, ValueError) as error:
            raise DataError(
                f"a sample is one number for each of {len(self.effort)} joints: {error}",
                hint="give q, qd and qdd of every joint of the model's robot",
            ) from error
        if self._library.hil_step(*(self._explained if explain else self._call)):
            raise DataError(
                "a sample holds what is not finite, or beyond 1e6",
                hint="nothing of it is remembered; look at where the motion comes from",
            )
        return self.effort


def _loaded(model: RobotEstimator) -> ctypes.CDLL:
    """The library; its file may go once it is mapped."""
    source = c_source(program_of(model))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in (("hil.h", source.header), ("hil.c", source.source), ("shim.c", SHIM)):
            (folder / file).write_text(text, "utf-8")
        library = ctypes.CDLL(str(built(folder, ("hil.c", "shim.c"), "hil.so", FAST)))
    library.hil_state_size.restype = ctypes.c_size_t
    library.hil_reset.argtypes = [Pointer]
    library.hil_reset.restype = None
    library.hil_set_load.argtypes = [Pointer, ctypes.c_double, Pointer, Pointer]
    library.hil_step.argtypes = [Pointer] * 6
    return library
