"""What is done to recorded signals before identification, as data."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Cutoff = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Preset = Literal["paper"]

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "order": 5,
        "unit": "hz",
        "position": 50.0,
        "velocity": 50.0,
        "acceleration": 50.0,
        "effort": 50.0,
    }
}
"""Section IV of the PINN paper: recorded at 1 kHz, a fifth-order Butterworth filter at 50 Hz
forwards and backwards over everything; what it keeps of the samples afterwards it does not say."""


class FilterSettings(BaseModel):
    """How a dataset is prepared for identification.

    Made from keys and values, or from the name of a preset, whose values keys beside it replace.

    Attributes:
        preset: Where settings not given come from, None for the defaults.
        order: Order of the Butterworth filter; run twice, it acts with twice the order.
        unit: Whether cut-offs are fractions of the Nyquist frequency or Hz.
        position: Cut-off for `q`, None to leave it as measured.
        velocity: Cut-off for `qd`.
        acceleration: Cut-off for `qdd`, applied after differentiating the filtered velocity.
        effort: Cut-off for `effort`, the fitting target.
        velocity_from: What `qd` is: as measured (where it was), or the derivative of `q`.
        derivative: How signals are differentiated.
        window: Samples in each fit of `savitzky-golay`, odd.
        degree: Degree of its polynomials.
        every: A fit uses every so manyth filtered sample.
        rate_hz: The same as a rate: the nearest that whole steps allow. None for `every`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Preset | None = None
    order: Annotated[int, Field(ge=1, le=10)] = 5
    unit: Literal["nyquist", "hz"] = "nyquist"
    position: Cutoff | None = None
    velocity: Cutoff = 0.15
    acceleration: Cutoff = 0.15
    effort: Cutoff = 0.20
    velocity_from: Literal["measured", "position"] = "measured"
    derivative: Literal["central", "savitzky-golay"] = "central"
    window: Annotated[int, Field(ge=3, le=201)] = 9
    degree: Annotated[int, Field(ge=1, le=6)] = 3
    every: Annotated[int, Field(ge=1)] = 1
    rate_hz: Cutoff | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, given: Any) -> Any:
        keys = {"preset": given} if isinstance(given, str) else given
        if not isinstance(keys, dict):
            return keys
        return {**PRESETS.get(str(keys.get("preset")), {}), **keys}

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if self.window % 2 == 0 or self.window <= self.degree:
            raise ValueError(
                f"window: {self.window} samples must be odd and more than the degree {self.degree}"
            )
        if self.every > 1 and self.rate_hz is not None:
            raise ValueError("every, rate_hz: two ways of saying the same; give one of them")
        return self

    @property
    def thins(self) -> bool:
        """Whether a fit leaves samples out."""
        return self.every > 1 or self.rate_hz is not None
