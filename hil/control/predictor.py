"""A fitted model in a loop: one sample in, effort and its parts out.

`Predictor` is the C program of the model, compiled when it is asked for and called through ctypes,
or the model's own stream where that cannot be. Machine code is optimised for this machine, so it is
compared with the model's stream before it is used (`CompiledProgram`).
"""

from __future__ import annotations

import ctypes
import shlex
import tempfile
from pathlib import Path

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray, PluginError, SpecError
from hil.estimators import RobotEstimator
from hil.export import (
    LOAD,
    PARTS,
    NotExported,
    Program,
    c_source,
    closeness,
    compile_program,
    compiler,
    golden_of,
    program_of,
    require_compiler,
)


class Predictor:
    """What a model says of each sample of a motion, as it comes.

    Where a C compiler is found and the model is of a kind that is exported, it is machine code that
    was compared with the model, and allocates nothing in steady state; else it is the model's own
    stream, slower and without parts. It has one state, so it belongs to one thread at a time.
    Friction and networks remember: feed every sample, at the rate of the training.

    Args:
        model: Fitted.
        payload: What is mounted.
        compiled: True insists on machine code, False on Python; None takes what there is.

    Attributes:
        compiled: Which it is.

    Raises:
        FitError: The program does not compile or agree with the model, or `compiled` is asked for
            and the model is of a kind that is not exported.
        PluginError: The compiler makes nothing that runs here, or `compiled` is asked for and
            there is none.
        SpecError: `model` is no model (but perhaps its path), or `payload` is no `Payload`.
    """

    def __init__(
        self,
        model: RobotEstimator,
        payload: Payload | None = None,
        *,
        compiled: bool | None = None,
    ) -> None:
        _require(isinstance(model, RobotEstimator), "model", model, "load_model_file(folder)")
        _require(isinstance(payload, Payload | None), "payload", payload, "Payload(1.5)  # kg")
        self._model, self._load = model, payload or Payload()
        self._program = _program(model, compiled)
        self.compiled = self._program is not None
        self.reset()

    def reset(self) -> None:
        """Begin afresh with the next sample; the load stays."""
        if self._program is None:
            self._stream = self._model.stream(self._load)
            return
        self._program.reset()
        self._program.mount(self._load)

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Effort (n,) of one sample, each input (n,).

        Of a compiled predictor the same array comes back every time: copy what is to stay.

        Raises:
            DataError: An input is not one finite number per joint, or beyond 1e6.
        """
        if self._program is None:
            sample = as_sample(self._model.robot_.n, q, qd, qdd)
            require_within(sample)
            return self._stream.step(*sample)
        return self._program.step(q, qd, qdd)

    def explain(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """The same step, in parts: gravity, inertia, load, friction, ripple, drive, residual.

        Raises:
            DataError: As `step`.
            FitError: The predictor is not compiled.
        """
        if self._program is None:
            raise FitError(
                "parts of single samples need a compiled predictor",
                hint="install a C compiler, or use predict on a whole dataset",
            )
        self._program.step(q, qd, qdd, explain=True)
        return self._program.parts


def _require(right: bool, name: str, given: object, example: str) -> None:
    if not right:
        raise SpecError(
            f"{name} is {given!r:.80}, a {type(given).__name__}", hint=f"for example: {example}"
        )


def _program(model: RobotEstimator, compiled: bool | None) -> CompiledProgram | None:
    if compiled is False or (compiled is None and compiler() is None):
        return None
    try:
        return CompiledProgram(model)
    except NotExported:
        if compiled:
            raise
        return None


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

REFUSED = "a sample holds what is not finite, or beyond 1e6"
HINT = "nothing of it is remembered; look at where the motion comes from"


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
        made = compile_program(folder, ("hil.c", "shim.c"), "hil.so", FAST)
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


MOST = 1e6
"""Beyond it no position, velocity or acceleration is taken."""


def as_sample(n: int, *rows: FloatArray) -> FloatArray:
    """(k, n) of k rows that are one number for each of n joints.

    Raises:
        DataError: One of them is not.
    """
    taken = np.empty((len(rows), n))
    for place, row in enumerate(rows):
        try:
            given = np.asarray(row)
        except ValueError:  # of rows that differ in length
            given = np.empty(0)
        if given.shape != (n,) or given.dtype.kind not in "iuf":
            raise DataError(
                f"a sample is one number for each of {n} joints, not {str(row)[:60]}",
                hint="give q, qd and qdd of every joint of the model's robot",
            )
        taken[place] = given
    return taken


def require_within(sample: FloatArray) -> None:
    """Refuse what is not finite, or beyond `MOST`.

    Raises:
        DataError: It is.
    """
    if not np.all(np.abs(sample) <= MOST):
        raise DataError(REFUSED, hint=HINT)
