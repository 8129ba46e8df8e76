"""A fitted model in a loop: one sample in, effort and its parts out."""

from __future__ import annotations

from hil.arms import Payload
from hil.control.compiled import CompiledProgram
from hil.control.sample import as_sample, require_within
from hil.core import FitError, FloatArray, SpecError
from hil.estimators import RobotEstimator
from hil.export import NotExported, compiler


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
