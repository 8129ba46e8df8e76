"""Sample-wise evaluation of a fitted model: one motion sample in, effort and its parts out.

The class `Predictor` compiles the C program of the model and calls it through ctypes, or uses the
Python stream of the model if compilation is not possible. The machine code is optimized for this
computer; `CompiledProgram` therefore compares its efforts with the stream of the model before use.
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
    """Prediction of the effort of a model for each sample of a motion.

    If a C compiler is available and the kind of model can be exported, the predictor uses machine
    code. The machine code is compared with the model before use and allocates no memory after the
    first samples. If machine code is not possible, the predictor uses the Python stream of the
    model, which is slower and returns no parts. A predictor has one internal state, so that only
    one thread at a time can use the predictor. Friction models and networks have memory: the caller
    must pass every sample, at the sample rate of the training data.

    Args:
        model: Fitted model.
        payload: Mounted payload.
        compiled: Whether machine code is required: True requires machine code, False requires
            Python, None uses machine code if possible.

    Attributes:
        compiled: Whether the predictor uses machine code.

    Raises:
        FitError: The program does not compile or its efforts differ from the model; or `compiled`
            is true, and the kind of model cannot be exported.
        PluginError: The compiled program does not run on this computer; or `compiled` is true, and
            no C compiler is installed.
        SpecError: `model` is not a model (for example its path), or `payload` is not a `Payload`.
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
        """Reset the state of the model before the next sample; the payload remains set."""
        if self._program is None:
            self._stream = self._model.stream(self._load)
            return
        self._program.reset()
        self._program.mount(self._load)

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the effort (n,) of one sample; each input has shape (n,).

        A compiled predictor returns the same array object every time: copy the values that are
        needed later.

        Raises:
            DataError: An input is not one finite number per joint, or exceeds 1e6.
        """
        if self._program is None:
            sample = as_sample(self._model.robot_.n, q, qd, qdd)
            require_within(sample)
            return self._stream.step(*sample)
        return self._program.step(q, qd, qdd)

    def explain(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        """Return the parts of the effort of one step, by name.

        The parts are gravity, inertia, load, friction, ripple, drive and residual.

        Raises:
            DataError: See `step`.
            FitError: The predictor does not use machine code.
        """
        if self._program is None:
            raise FitError(
                "prediction of parts needs a compiled predictor",
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
"""Number of samples for which machine code and stream of a model are compared, without and with
a payload."""

REFUSED = "a sample contains a value that is not finite or exceeds 1e6"
HINT = "the sample was ignored; check the source of the motion"


class CompiledProgram:
    """Machine code of the stream of one model.

    The method `step` allocates no memory: inputs are copied into permanent arrays, and efforts are
    read from permanent arrays.

    Args:
        model: Fitted model.

    Attributes:
        effort: (n,) effort of the newest sample; the next sample overwrites the array.
        parts: (n,) parts of the effort by name after a call of `step` with `explain`; the sum of
            the parts is the effort.

    Raises:
        NotExported: The kind of model cannot be exported.
        FitError: The program does not compile or its efforts differ from the model.
        PluginError: No C compiler is installed, or the compiler does not support this computer.
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
        """Reset the state of the model before the next sample and remove the payload."""
        self._library.hil_reset(self._where)

    def mount(self, payload: Payload) -> None:
        """Set the payload that is valid from the next sample on.

        Raises:
            DataError: The payload is not valid.
        """
        com, inertia = np.array(payload.com), np.array(payload.inertia)
        places = Pointer(com.ctypes.data), Pointer(inertia.ctypes.data)
        if self._library.hil_set_load(self._where, ctypes.c_double(payload.mass), *places):
            raise DataError(f"{payload} is not a payload", hint="use finite numbers and a mass ≥ 0")

    def step(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray, *, explain: bool = False
    ) -> FloatArray:
        """Return the array `effort` (n,) for one sample; each input has shape (n,).

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
        """Raise if the efforts of the machine code differ from the model.

        The machine code is optimized for this computer, so that tests of the portable C program are
        not sufficient.
        """
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
                        hint="use Predictor(…, compiled=False), and report this with the "
                        "model's folder and the compiler's version",
                    )


def _loaded(program: Program) -> ctypes.CDLL:
    """Return the compiled library; its file can be deleted after loading."""
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
                f"cannot load the program compiled by {shlex.join(require_compiler())}: {error}",
                hint="set a C compiler for this machine with CC=…, or use compiled=False",
            ) from error
    library.hil_state_size.restype = ctypes.c_size_t
    library.hil_reset.argtypes = [Pointer]
    library.hil_reset.restype = None
    library.hil_set_load.argtypes = [Pointer, ctypes.c_double, Pointer, Pointer]
    library.hil_step.argtypes = [Pointer] * 6
    return library


MOST = 1e6
"""Maximum accepted magnitude of a position, velocity or acceleration."""


def as_sample(n: int, *rows: FloatArray) -> FloatArray:
    """Return an array (k, n) of k rows with one number per joint.

    Raises:
        DataError: A row does not have one number for each of the n joints.
    """
    taken = np.empty((len(rows), n))
    for place, row in enumerate(rows):
        try:
            given = np.asarray(row)
        except ValueError:  # rows of different lengths
            given = np.empty(0)
        if given.shape != (n,) or given.dtype.kind not in "iuf":
            raise DataError(
                f"a sample is one number for each of {n} joints, not {str(row)[:60]}",
                hint="pass q, qd and qdd of every joint of the robot",
            )
        taken[place] = given
    return taken


def require_within(sample: FloatArray) -> None:
    """Raise if a value is not finite or exceeds `MOST`.

    Raises:
        DataError: A value is not finite or exceeds `MOST`.
    """
    if not np.all(np.abs(sample) <= MOST):
        raise DataError(REFUSED, hint=HINT)
