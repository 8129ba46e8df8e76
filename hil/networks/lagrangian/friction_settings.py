"""What friction may look like beside a Lagrangian network; needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias

from hil.core import SpecError
from hil.estimators import choice, flag, number, require_known, whole

FrictionKind: TypeAlias = Literal["none", "coulomb", "stribeck", "dissipative", "unconstrained"]

FRICTIONS: tuple[FrictionKind, ...] = (
    "none",
    "coulomb",
    "stribeck",
    "dissipative",
    "unconstrained",
)
"""Methods 4 (none), 6 (Coulomb–viscous), Proposed (Stribeck) and both forms of 5."""

Sign: TypeAlias = Literal["given", "hard"]

Bounds: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class FrictionSettings:
    """How friction is parametrised.

    Bounds and unit are not taste: v_s, δ_s and α make up for each other, and without bounds end
    where no joint is; and coefficients in plain N·m move so slowly beside the network's weights
    that the network learns friction as gravity first.

    Attributes:
        sign: `given`: the direction the caller hands over (smooth sign, or Dahl's state); `hard`:
            sign(q̇) of the paper, whatever is handed over.
        scaled: Coefficients have `unit` times the joint's torque for a unit, and networks its
            torque; otherwise 1 N·m.
        unit: Share of the joint's standard deviation of torque, and what f_s, f_c, f_v start at.
        start: What they start at without `scaled` [N·m].
        bounded: f_s, f_c, f_v ≥ 0 and v_s, δ_s, α within their bounds.
        speed_bounds: Of v_s [rad/s].
        shape_bounds: Of δ_s.
        exponent_bounds: Of α.
        start_speed, start_shape, start_exponent: What v_s, δ_s, α start at.
        offset: Stribeck friction has a constant beside eq. 18 (of sensors and drives: the one part
            that is not passive). Coulomb–viscous friction has one by definition, eq. 3.
        hidden: Widths of the hidden layers of a dissipative or an unconstrained network.
        rest_speed: Below about this speed [rad/s] the damping of a dissipative network no longer
            grows as speed falls. An estimator hands over the width of its smooth sign.
    """

    sign: Sign = "given"
    scaled: bool = True
    unit: float = 0.3
    start: float = 0.1
    bounded: bool = True
    speed_bounds: Bounds = (0.02, 0.3)
    shape_bounds: Bounds = (0.5, 2.5)
    exponent_bounds: Bounds = (0.5, 1.2)
    start_speed: float = 0.08
    start_shape: float = 1.2
    start_exponent: float = 0.8
    offset: bool = True
    hidden: tuple[int, ...] = (128, 128)
    rest_speed: float = 0.01

    def __post_init__(self) -> None:
        choice("sign", self.sign, ("given", "hard"))
        for name in ("scaled", "bounded", "offset"):
            flag(name, getattr(self, name))
        for name in ("unit", "start", "start_speed", "start_shape", "start_exponent"):
            self._set(name, number(name, getattr(self, name), above=0.0))
        self._set("rest_speed", number("rest_speed", self.rest_speed, at_least=0.0))
        for pair, start in BOUNDED.items():
            self._set(pair, _bounds(pair, getattr(self, pair)))
            if self.bounded:
                _require_inside(start, getattr(self, start), pair, getattr(self, pair))
        widths = _sequence("hidden", self.hidden)
        self._set(
            "hidden", tuple(whole("hidden", width, at_least=1, at_most=4096) for width in widths)
        )

    @staticmethod
    def literal() -> FrictionSettings:
        """As the paper says: hard sign, N·m, free parameters, no offset."""
        return FrictionSettings(
            sign="hard", scaled=False, bounded=False, offset=False,
            start_speed=0.1, start_shape=1.0, start_exponent=1.0,
        )  # fmt: skip

    @staticmethod
    def given(settings: dict[str, Any]) -> FrictionSettings:
        """From keyword arguments, as a spec has them.

        Raises:
            SpecError: There is no such setting, or it cannot have that value.
        """
        require_known(settings, tuple(f.name for f in fields(FrictionSettings)), "friction")
        return FrictionSettings(**settings)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # lists of a YAML file become tuples


BOUNDED = {
    "speed_bounds": "start_speed",
    "shape_bounds": "start_shape",
    "exponent_bounds": "start_exponent",
}
"""Bounds → where the parameter within them starts."""


def _bounds(name: str, value: Any) -> Bounds:
    pair = _sequence(name, value)
    if len(pair) != 2:
        raise SpecError(f"{name} is {value!r}, but must be the lowest and the highest value")
    low, high = (number(name, limit, above=0.0) for limit in pair)
    if low >= high:
        raise SpecError(f"{name} is {value!r}, but the first must be below the second")
    return low, high


def _require_inside(name: str, value: float, pair: str, bounds: Bounds) -> None:
    low, high = bounds
    if not low < value < high:
        raise SpecError(
            f"{name} is {value:g}, but must be between {low:g} and {high:g}",
            hint=f"change {name}, or {pair}",
        )


def _sequence(name: str, value: Any) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise SpecError(f"{name} is {value!r}, but must be a list of numbers")
    return tuple(value)
