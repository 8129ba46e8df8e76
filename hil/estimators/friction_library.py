"""The friction library: what the friction of a joint can be made of, and a law chosen from it.

A `FrictionMotion` holds what friction may depend on: motion, torque through the gear, memory,
temperature. Named groups of columns, linear in their coefficients, are computed from it (`groups`).
Every group is a piece of physics that a robot may show or not. The data of a joint decide which of
them it gets (`hil.estimators.friction_fit`); the outcome is a `FrictionLaw`. In the list of groups
z is Dahl's state in place of sign(v), τ the torque through the gear; vs, p and x₀ are the shapes,
the few parameters that are not linear:

- `core`: offset, viscous v and Coulomb friction z;
- `load`: z·|τ|, the gear's efficiency (6–8 % on UR arms);
- `stribeck…`: z·exp(−|v|/vs), and with load; PINN paper eq. 15–18 with an exponent of 1;
- `memory …`: states with longer lengths, and with load;
- `speed …`: sign(v)·|v|^p; `asymmetry`, `braking`: other friction one way, or as the load drives;
- `drive`: current that grows faster than torque; `turn …`: what repeats with the joint's turn;
- `ripple k`: k times per motor turn, evenly, fading with speed, and with the sign of the motion;
- `temperature`: Coulomb and viscous friction per kelvin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hil.core import FloatArray
from hil.data import (
    AT_REST,
    Conditions,
    Dataset,
    FilterSettings,
    nyquist_fraction,
    sample_rate,
    zero_phase,
)
from hil.estimators.friction_memory import dahl_states, path_steps

MULTIPLES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Lengths of the friction states as multiples of the shortest: from microslip in the contacts to
the winding-up of a whole gear."""

RIPPLE_FADES_RAD_S = 0.3
"""A controller fights slow ripple with current; fast ripple the rotor's inertia swallows."""

SENSE_RAD_S = 0.01
"""Width of the smooth sign of the velocity in ripple [rad/s]."""

REFERENCE_C = 30.0
"""Temperature at which columns of temperature vanish."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """The parameters of friction that are not linear, per joint.

    Attributes:
        length: (n,) shortest length of the friction state, x₀ [rad].
        stribeck: (n,) speed at which the Stribeck peak has fallen to 1/e [rad/s].
        power: (n,) exponent of the concave speed law sign(v)·|v|^p.
        turns: (n,) motor turns per joint turn; NaN where unknown.
    """

    length: FloatArray
    stribeck: FloatArray
    power: FloatArray
    turns: FloatArray

    def to_array(self) -> FloatArray:
        """(4, n) for the model file."""
        return np.stack([self.length, self.stribeck, self.power, self.turns])

    @staticmethod
    def from_array(values: FloatArray) -> Shapes:
        """Inverse of `to_array`."""
        return Shapes(*values)


@dataclass(eq=False)
class FrictionMotion:
    """One series, seen by the columns. All arrays are (N, n).

    Attributes:
        q: Position [rad].
        v: Velocity [rad/s].
        transmitted: Torque through the gear: rigid body and load, without friction [N·m].
        shapes: See there.
        steps: Way since the sample before [rad]; not needed with `given`.
        celsius: Joint temperature, None when it was not recorded.
        given: States by multiple where they are known already, as in a stream.
    """

    q: FloatArray
    v: FloatArray
    transmitted: FloatArray
    shapes: Shapes
    steps: FloatArray | None = None
    celsius: FloatArray | None = None
    given: Mapping[float, FloatArray] | None = None
    _states: dict[float, FloatArray] = field(default_factory=dict, repr=False)

    def state(self, multiple: float = 1.0) -> FloatArray:
        """Dahl's state with `multiple` times the shortest length."""
        if self.given is not None:
            return self.given[multiple]
        if multiple not in self._states:
            assert self.steps is not None
            self._states[multiple] = dahl_states(self.steps, multiple * self.shapes.length)
        return self._states[multiple]

    @cached_property
    def speed(self) -> FloatArray:
        """|v|."""
        return np.abs(self.v)

    @cached_property
    def load(self) -> FloatArray:
        """|transmitted torque|."""
        return np.abs(self.transmitted)

    @cached_property
    def z(self) -> FloatArray:
        """The shortest state."""
        return self.state()

    def peak(self, width: float = 1.0) -> FloatArray:
        """Stribeck's exp(−|v|/vs), vs `width` times as wide."""
        return np.asarray(np.exp(-self.speed / (width * self.shapes.stribeck)))

    def law(self, power: FloatArray | float) -> FloatArray:
        """sign(v)·|v|^power."""
        return np.asarray(np.sign(self.v) * self.speed**power)

    @cached_property
    def slow(self) -> FloatArray:
        """How much of the ripple the controller answers at this speed, 1 at rest."""
        return np.asarray(np.exp(-self.speed / RIPPLE_FADES_RAD_S))

    @cached_property
    def direction(self) -> FloatArray:
        """The sign of the motion, smooth through 0."""
        return np.asarray(np.tanh(self.v / SENSE_RAD_S))

    @cached_property
    def warmth(self) -> FloatArray:
        """Temperature over the reference [K]; 0 where unknown."""
        if self.celsius is None:
            return np.zeros_like(self.v)
        return np.nan_to_num(self.celsius - REFERENCE_C)


Columns = Callable[[FrictionMotion], Sequence[FloatArray]]

CORE = "core"


def _core(m: FrictionMotion) -> Sequence[FloatArray]:
    return np.ones_like(m.v), m.v, m.z


_DRY: Mapping[str, Columns] = {
    CORE: _core,
    "load": lambda m: (m.z * m.load,),
    "stribeck": lambda m: (m.z * m.peak(),),
    "stribeck narrow": lambda m: (m.z * m.peak(0.3),),
    "stribeck wide": lambda m: (m.z * m.peak(3.0),),
    "stribeck load": lambda m: (m.z * m.peak() * m.load,),
    "stribeck wide load": lambda m: (m.z * m.peak(3.0) * m.load,),
    "stribeck memory": lambda m: (m.state(10.0) * m.peak(0.3),),
    "braking": lambda m: (np.abs(m.z) * m.transmitted,),
    "drive": lambda m: (m.transmitted * m.load,),
}


def _memory(multiple: float) -> dict[str, Columns]:
    name = f"memory {multiple:g}"
    return {
        name: lambda m: (m.state(multiple),),
        f"{name} load": lambda m: (m.state(multiple) * m.load,),
    }


_SPEED: Mapping[str, Columns] = {
    "speed p": lambda m: (m.law(m.shapes.power),),
    "speed 0.25": lambda m: (m.law(0.25),),
    "speed 0.5": lambda m: (m.law(0.5),),
    "speed 1.5": lambda m: (m.law(1.5),),
    "speed 2": lambda m: (m.law(2.0),),
    "speed p load": lambda m: (m.law(m.shapes.power) * m.load,),
    "speed 1 load": lambda m: (m.v * m.load,),
    "speed 2 load": lambda m: (m.law(2.0) * m.load,),
    "asymmetry": lambda m: (m.speed,),
    "dry asymmetry": lambda m: (np.abs(m.z),),
    "speed braking": lambda m: (m.speed * m.transmitted,),
}


def _turn(order: int) -> dict[str, Columns]:
    def waves(m: FrictionMotion) -> tuple[FloatArray, FloatArray]:
        return np.sin(order * m.q), np.cos(order * m.q)

    return {
        f"turn {order}": waves,
        f"turn {order} dry": lambda m: tuple(m.z * wave for wave in waves(m)),
    }


def _ripples(order: int) -> dict[str, Columns]:
    def waves(m: FrictionMotion) -> tuple[FloatArray, FloatArray]:
        angle = order * np.nan_to_num(m.shapes.turns) * m.q
        return np.sin(angle), np.cos(angle)

    def times(factor: Callable[[FrictionMotion], FloatArray]) -> Columns:
        return lambda m: tuple(factor(m) * wave for wave in waves(m))

    return {
        f"ripple {order}": waves,
        f"ripple {order} slow": times(lambda m: m.slow),
        f"ripple {order} sign": times(lambda m: m.direction),
        f"ripple {order} slow sign": times(lambda m: m.slow * m.direction),
    }


ORDERS = (1, 2, 4, 8, 10, 12)
"""Ripple periods per motor turn: gear teeth (1, 2) and the poles and slots of servo motors."""


def groups(*, ripple: bool, temperature: bool) -> dict[str, Columns]:
    """All groups that a robot can have.

    Args:
        ripple: Motor turns per joint turn are known.
        temperature: Joint temperatures were recorded.
    """
    found = dict(_DRY)
    for multiple in MULTIPLES[1:]:
        found |= _memory(multiple)
    found |= _SPEED
    for order in (1, 2):
        found |= _turn(order)
    for order in ORDERS if ripple else ():
        found |= _ripples(order)
    if temperature:
        found["temperature"] = lambda m: (m.z * m.warmth, m.law(m.shapes.power) * m.warmth)
    return found


def column_names(group: str, count: int) -> tuple[str, ...]:
    """Names of a group's columns."""
    if group == CORE:
        return ("offset", "viscous", "coulomb")
    return (group,) if count == 1 else tuple(f"{group}.{i + 1}" for i in range(count))


LADDER = (
    ("speed p",),
    ("load", "stribeck"),
    ("memory 3", "memory 30", "speed 0.25"),
    ("speed 1 load", "speed p load", "speed braking", "braking"),
    ("stribeck narrow", "stribeck wide"),
)
"""What each step up adds to a joint's friction. Chosen on four UR10e trajectories, each left out in
turn: broad steps that all joints share predict new trajectories better than column by column."""


def rungs(*, ripple: bool, temperature: bool) -> list[tuple[str, ...]]:
    """Groups from the fewest to the most, each list holding the one before; see `groups`."""
    steps = list(LADDER)
    if ripple:
        steps.append(tuple(f"ripple {k}{how}" for k in ORDERS for how in ("", " slow", " sign")))
    if temperature:
        steps.append(("temperature",))
    taken: tuple[str, ...] = (CORE,)
    return [taken, *(taken := (*taken, *step) for step in steps)]


LOADED = frozenset(
    {"load", "stribeck load", "stribeck wide load", "braking", "drive", "speed p load",
     "speed 1 load", "speed 2 load", "speed braking"}
    | {f"memory {k:g} load" for k in MULTIPLES[1:]}
)  # fmt: skip
"""Groups whose columns grow with the torque through the gear."""

LEAST_LOAD = 0.2
"""Torque through a gear, as a share of what is left to friction (root mean squares), below which
the joint gets none of `LOADED`: fitted to next to no load, they would be anything under a real
one. A UR10e's wrist 2 and 3 transmit a tenth and less."""

PARTS = {"ripple": "ripple", "drive": "drive"}
"""First word of a group → the part of the effort it belongs to; all others are friction."""


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """What friction, ripple and drive add to each joint.

    Attributes:
        chosen: Groups per joint, in the order of their coefficients.
        coefficients: Per joint, of its groups' columns.
        shapes: The parameters that are not linear.
        celsius: (n,) usual joint temperature of the training, for where it is not known.
    """

    chosen: tuple[tuple[str, ...], ...]
    coefficients: tuple[FloatArray, ...]
    shapes: Shapes
    celsius: FloatArray | None = None

    @classmethod
    def from_flat(
        cls,
        chosen: tuple[tuple[str, ...], ...],
        flat: FloatArray,
        shapes: Shapes,
        celsius: FloatArray | None = None,
    ) -> FrictionLaw:
        """From all coefficients behind each other, joint by joint.

        Raises:
            KeyError: There is no such group.
            ValueError: There are more or fewer coefficients or joints than the groups have.
        """
        law, n = cls(chosen, (), shapes), len(chosen)
        counts = [sum(law.count(name) for name in names) for names in chosen]
        if flat.shape != (sum(counts),) or shapes.length.shape != (n,):
            raise ValueError(
                f"friction: {flat.size} coefficients and shapes of {shapes.length.size} joints "
                f"for {sum(counts)} columns and {n} joints"
            )
        return cls(chosen, tuple(np.split(flat, np.cumsum(counts)[:-1])), shapes, celsius)

    def torques(self, motion: FrictionMotion) -> dict[str, FloatArray]:
        """Parts `friction`, `ripple` and `drive`, each (N, n) [N·m]; only those there are."""
        found: dict[str, FloatArray] = {"friction": np.zeros_like(motion.v)}
        for name, weights in self._weights.items():
            part = PARTS.get(name.split()[0], "friction")
            torque = found.setdefault(part, np.zeros_like(motion.v))
            for column, weight in zip(self._library[name](motion), weights, strict=True):
                torque += column * weight
        return found

    def break_away(self) -> FloatArray:
        """Return the friction (n,) that an unloaded joint at rest holds before it slides [N·m].

        At rest the speed laws vanish, and what is left is carried by the states. A joint slides
        once all of them are wound up; forth and back are averaged, which leaves out offset and
        asymmetry. Friction that changes with the angle of a joint counts where it is least.
        """
        turn = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
        q = np.broadcast_to(turn[:, None], (len(turn), len(self.chosen)))
        still = np.zeros_like(q)
        celsius = None if self.celsius is None else np.broadcast_to(self.celsius, q.shape)

        def wound_up(sign: float) -> FloatArray:
            states = dict.fromkeys(MULTIPLES, np.full_like(q, sign))
            rest = FrictionMotion(q, still, still, self.shapes, celsius=celsius, given=states)
            return self.torques(rest)["friction"]

        level: FloatArray = 0.5 * (wound_up(1.0) - wound_up(-1.0)).min(axis=0)
        return np.maximum(level, 0.0)

    def parameter_names(self, joint_names: Sequence[str]) -> tuple[str, ...]:
        """Names of all coefficients, joint by joint."""
        return tuple(
            f"{joint}.{column}"
            for joint, names in zip(joint_names, self.chosen, strict=True)
            for name in names
            for column in column_names(name, self.count(name))
        )

    @cached_property
    def _library(self) -> Mapping[str, Columns]:
        return groups(ripple=True, temperature=True)

    @cached_property
    def _weights(self) -> dict[str, list[FloatArray]]:
        """Per group, for each of its columns the coefficient of every joint; 0 without it."""
        n, found = len(self.chosen), dict[str, list[FloatArray]]()
        for j, names in enumerate(self.chosen):
            at = 0
            for name in names:
                count = self.count(name)
                weights = found.setdefault(name, [np.zeros(n) for _ in range(count)])
                for i in range(count):
                    weights[i][j] = self.coefficients[j][at + i]
                at += count
        return found

    def count(self, name: str) -> int:
        """How many columns, and so coefficients, a group has.

        Raises:
            KeyError: There is no such group.
        """
        probe = np.zeros((1, len(self.chosen)))
        states = dict.fromkeys(MULTIPLES, probe)
        motion = FrictionMotion(probe, probe, probe, self.shapes, given=states)
        return len(self._library[name](motion))


def predicted_friction(
    law: FrictionLaw, data: Dataset, transmitted: FloatArray, filters: FilterSettings
) -> dict[str, FloatArray]:
    """Parts of the friction law, each (N, n) [N·m], as far as the filtered motion goes.

    Args:
        law: As it was found.
        data: Prepared with `filters`.
        transmitted: (N, n) torque through the gears [N·m].
        filters: The velocity's cut-off smooths what is predicted from it.
    """
    out: dict[str, FloatArray] = {}
    for condition, rows, motion in motions(
        data, path_steps(data), transmitted, law.shapes, law.celsius
    ):
        for name, torque in law.torques(motion).items():
            whole = out.setdefault(name, np.zeros_like(transmitted))
            t = data["t"][rows]
            whole[rows] = smoothed(torque, condition, t, filters, cutoff=filters.velocity)
    return out


def motions(
    dataset: Dataset,
    steps: FloatArray,
    transmitted: FloatArray,
    shapes: Shapes,
    usual: FloatArray | None = None,
) -> Iterator[tuple[Conditions, slice, FrictionMotion]]:
    """Conditions, rows and motion of every series that has rows.

    Args:
        dataset: Prepared.
        steps: (N, n) from `path_steps` [rad].
        transmitted: (N, n) torque through the gears [N·m].
        shapes: Of the friction.
        usual: (n,) joint temperatures where none were recorded.
    """
    celsius = temperatures(dataset, usual)
    for condition, rows in dataset.slices():
        if rows.stop > rows.start:
            yield (
                condition,
                rows,
                FrictionMotion(
                    dataset["q"][rows],
                    dataset["qd_f"][rows],
                    transmitted[rows],
                    shapes,
                    steps[rows],
                    None if celsius is None else celsius[rows],
                ),
            )


def temperatures(dataset: Dataset, usual: FloatArray | None) -> FloatArray | None:
    """(N, n) recorded joint temperatures, the usual ones where there are none."""
    recorded = dataset.columns.get("temperature")
    if usual is None:
        return recorded
    if recorded is None:
        return np.broadcast_to(usual, dataset["q"].shape)
    return np.where(np.isfinite(recorded), recorded, usual)


def usual_temperatures(dataset: Dataset) -> FloatArray | None:
    """(n,) median joint temperatures; None where they were not recorded throughout."""
    recorded = dataset.columns.get("temperature")
    if recorded is None or not len(recorded) or not np.all(np.isfinite(recorded)):
        return None
    return np.asarray(np.median(recorded, axis=0))


def temperatures_vary(dataset: Dataset) -> bool:
    """Whether joint temperatures were recorded and changed by 1 K or more in some joint."""
    celsius = dataset.columns.get("temperature")
    if celsius is None or not np.all(np.isfinite(celsius)) or not len(celsius):
        return False
    return bool(np.max(np.ptp(celsius, axis=0)) >= 1.0)


def smoothed(
    values: FloatArray,
    condition: Conditions,
    t: FloatArray,
    settings: FilterSettings,
    *,
    cutoff: float | None = None,
) -> FloatArray:
    """Columns (N, …) of one series through a low-pass filter; at rest as they are.

    Args:
        values: A row per sample.
        condition: Of the series.
        t: (N,) [s].
        settings: Order and unit of the filter.
        cutoff: By default that of the effort the columns are to explain.
    """
    if condition.kind in AT_REST:
        return values
    chosen = settings.effort if cutoff is None else cutoff
    fraction = nyquist_fraction(chosen, settings.unit, sample_rate(t))
    return zero_phase(values, fraction, settings.order)
