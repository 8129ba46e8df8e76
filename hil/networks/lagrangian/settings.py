"""How a Lagrangian network is built; nothing here needs torch."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from hil.estimators import Whole

Activation = Literal["softplus", "relu", "tanh", "silu"]
Gain = Annotated[float, Field(gt=0.0, le=10.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False)]


Layers = Annotated[
    tuple[Annotated[Whole, Field(strict=True, ge=1, le=4096)], ...], Field(strict=False)
]
"""Lists of a YAML file become tuples."""


class NetworkSettings(BaseModel):
    """Structure and start of the network behind M(q) and g(q).

    Attributes:
        hidden: Units of each hidden layer, one layer at least.
        activation: Of the hidden layers. The torque holds its derivative: where that jumps (relu),
            so does the torque.
        features: What the first layer sees: `sincos` [cos q, sin q], the same after a whole turn,
            or `raw` q [rad].
        gravity: `potential` learns V(q) and takes its gradient, `head` learns g(q) itself, which
            need not be the gradient of anything.
        diagonal: What keeps the diagonal of the factor L of M = LLᵀ from below zero. With `relu`
            an entry can stay 0 for ever.
        epsilon: Keeps M from being singular.
        epsilon_of: What it is added to: the diagonal of the `factor`, or that of the `mass` matrix.
        scaled: Give row j of L the unit √(torque scale of joint j), and V the largest one, so that
            every joint starts with torques of its own size.
        hidden_gain: Standard deviation of hidden layers' first weights over Glorot's.
        output_gain: The same for the last layer.
        bias: First value of every bias …
        diagonal_bias: … but those of L's diagonal.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    hidden: Layers = (128, 128, 128)
    activation: Activation = "softplus"
    features: Literal["sincos", "raw"] = "sincos"
    gravity: Literal["potential", "head"] = "potential"
    diagonal: Literal["softplus", "relu"] = "softplus"
    epsilon: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 1e-3
    epsilon_of: Literal["factor", "mass"] = "factor"
    scaled: bool = True
    hidden_gain: Gain = 1.0
    output_gain: Gain = 0.3
    bias: Finite = 0.0
    diagonal_bias: Finite = 0.5

    @field_validator("hidden")
    @classmethod
    def _has_a_layer(cls, hidden: tuple[int, ...]) -> tuple[int, ...]:
        if not 1 <= len(hidden) <= 16:
            raise ValueError("a network has 1 to 16 hidden layers")
        return hidden

    @classmethod
    def literal(cls) -> NetworkSettings:
        """What the paper prints (Section II.B, III.A): ReLU, q as it is, g(q) as a head of its own.

        What it leaves open is as in the code that DeLaN's authors published: start weights, start
        biases, and 10⁻⁵ added to M.
        """
        return cls(
            activation="relu",
            features="raw",
            gravity="head",
            diagonal="relu",
            epsilon=1e-5,
            epsilon_of="mass",
            scaled=False,
            hidden_gain=2.0**0.5,
            output_gain=2.0**0.5,
            bias=0.1,
            diagonal_bias=0.1,
        )
