"""Lagrangian networks as plain arrays, so that programs can be written without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hil.core import FloatArray
from hil.export.program import PlainFriction
from hil.export.shaped import ShapedFriction
from hil.networks import Activation, FrictionKind, LagrangianModel

LEAST_REST_SPEED = 1e-4
LEAST_SPEED = 1e-6
"""As the friction of `hil.networks.lagrangian` has them, which torch is needed to read."""

Kind = Literal["float", "double"]


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Fully connected layers, the last one linear.

    Attributes:
        weights: Per layer (outputs, inputs).
        biases: Per layer (outputs,).
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LagrangianTerms:
    """τ = M(q)·q̈ + C(q, q̇)·q̇ + g(q) of one network, see `hil.networks.lagrangian.network`.

    Attributes:
        trunk: From features of q to raw outputs: L's diagonal, its rows below, V or g(q).
        kind: Precision in which it was trained.
        activation: Of the hidden layers.
        sincos: Features are [cos q, sin q], not q.
        rectified: L's diagonal goes through max(x, 0), not softplus.
        least: Added to L's diagonal.
        added: Added to M's diagonal.
        unit: (n,) of the rows of L [√(N·m s²)].
        potential: The last output is V, else there are n of g(q).
        gravity_unit: (1,) or (n,) of those [N·m].
    """

    trunk: Layers
    kind: Kind
    activation: Activation
    sincos: bool
    rectified: bool
    least: float
    added: float
    unit: FloatArray
    potential: bool
    gravity_unit: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class NetworkFriction:
    """Friction by a network of tanh layers that sees cos q, sin q and q̇.

    Attributes:
        layers: Outputs are the torques; of a dissipative one the entries of A, row by row.
        kind: Precision in which it was trained.
        dissipative: Torque is A·Aᵀ·q̇, and the network sees log(|q̇| + rest) in q̇'s place.
        scale: Of the outputs.
        rest_speed: Added to speeds [rad/s].
    """

    layers: Layers
    kind: Kind
    dissipative: bool
    scale: FloatArray
    rest_speed: float


def lagrangian_terms(model: LagrangianModel) -> LagrangianTerms:
    """Those of a fitted `lagrangian`."""
    from hil.networks import network_of

    settings = model.design_.network
    of_factor = settings.epsilon_of == "factor"
    dynamics = network_of(model.design_, model.torque_std_, model.weights_).dynamics
    # An entry of L's diagonal stands alone in its row of the placement.
    unit = dynamics.factor.placement[: model.robot_.n].sum(dim=-1).double().numpy()
    names = [f"dynamics.trunk.layers.{i}" for i in range(len(settings.hidden))]
    return LagrangianTerms(
        trunk=_layers(model.weights_, [*names, "dynamics.trunk.last"]),
        kind=_kind(model.weights_),
        activation=settings.activation,
        sincos=settings.features == "sincos",
        rectified=settings.diagonal == "relu",
        least=settings.epsilon if of_factor else 0.0,
        added=0.0 if of_factor else settings.epsilon,
        unit=unit,
        potential=settings.gravity == "potential",
        gravity_unit=dynamics.gravity_unit.double().numpy(),
    )


def lagrangian_friction(
    model: LagrangianModel,
) -> PlainFriction | ShapedFriction | NetworkFriction:
    """Friction of a fitted `lagrangian`."""
    kind: FrictionKind = model.design_.kind
    if kind in ("dissipative", "unconstrained"):
        return _network(model)
    n = model.robot_.n
    none, one = np.zeros(n), np.ones(n)
    width = 0.0 if model.design_.friction.sign == "hard" else model.sign_width
    length = None if model.design_.friction.sign == "hard" else model.length_
    found = model.intrinsic_
    if kind == "none" or (kind == "coulomb" and length is None):
        coulomb, viscous, offset = (found.get(name, none) for name in ("f_c", "f_v", "offset"))
        return PlainFriction(coulomb, viscous, offset, width, one, width or 1.0)
    stribeck = kind == "stribeck"
    return ShapedFriction(
        coulomb=found["f_c"],
        static=found.get("f_s", found["f_c"]),
        stribeck_speed=found.get("v_s", one),
        stribeck_exponent=found.get("delta_s", one),
        power=found["f_v"] if stribeck else none,
        exponent=found.get("alpha", one),
        viscous=none if stribeck else found["f_v"],
        offset=found.get("offset", none),
        sign_width=width,
        least_speed=LEAST_SPEED,
        more_speed=0.0,
        load=none,
        far=none,
        far_load=none,
        length=length,
        power_remembers=True,
    )


def _network(model: LagrangianModel) -> NetworkFriction:
    weights, settings = model.weights_, model.design_.friction
    names = [f"friction.network.{2 * i}" for i in range(len(settings.hidden) + 1)]
    return NetworkFriction(
        layers=_layers(weights, names),
        kind=_kind(weights),
        dissipative=model.design_.kind == "dissipative",
        scale=np.asarray(weights["friction.scale"], dtype=np.float64),
        rest_speed=max(settings.rest_speed, LEAST_REST_SPEED),
    )


def _layers(weights: Mapping[str, np.ndarray[Any, Any]], names: list[str]) -> Layers:
    def all_of(what: str) -> tuple[FloatArray, ...]:
        return tuple(np.asarray(weights[f"{name}.{what}"], dtype=np.float64) for name in names)

    return Layers(all_of("weight"), all_of("bias"))


def _kind(weights: Mapping[str, np.ndarray[Any, Any]]) -> Kind:
    doubled = any(value.dtype == np.float64 for value in weights.values())
    return "double" if doubled else "float"
