"""Library of friction columns, and friction law selected from these columns.

A `FrictionMotion` contains the inputs of friction: motion, torque through the gear, friction states
and temperature. `groups` returns named groups of columns that are linear in their coefficients.
Each group describes a physical effect that a robot may have or lack. The data of a joint determine
which groups it uses (`hil.estimators.friction_fit`); the selected law is a `FrictionLaw`. In the
following list of groups, z is Dahl's state, which replaces sign(v), and τ is the torque through the
gear. The shapes vs, p and x₀ are nonlinear parameters.

- `core`: offset, viscous friction v and Coulomb friction z.
- `load`: z·|τ|, friction due to the efficiency of the gear (6–8 % on UR arms).
- `stribeck…`: z·exp(−|v|/vs), also multiplied by the load; PINN paper eq. 15–18 with an exponent of
  1.
- `memory …`: friction states with longer lengths, also multiplied by the load.
- `speed …`: sign(v)·|v|^p.
- `asymmetry`, `braking`: friction that depends on the direction of motion, or on whether the load
  drives the joint.
- `drive`: motor current that increases faster than the torque.
- `turn …`: effects that are periodic in the joint angle.
- `ripple k`: ripple with k periods per motor turn, constant, fading with speed, or with the sign of
  the motion.
- `temperature`: change of Coulomb and viscous friction per kelvin.
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
"""Lengths of the friction states as multiples of the shortest length.

The lengths of the friction states range from microslip in the contacts to the torsion of a whole
gear.
"""

RIPPLE_FADES_RAD_S = 0.3
"""Speed at which ripple has decayed [rad/s].

A controller compensates slow ripple with current, whereas the rotor inertia absorbs fast ripple.
"""

SENSE_RAD_S = 0.01
"""Width of the smoothed velocity sign in ripple columns [rad/s]."""

REFERENCE_C = 30.0
"""Temperature at which temperature columns are zero [°C]."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Nonlinear friction parameters of each joint.

    Attributes:
        length: (n,) shortest length of the friction state, x₀ [rad].
        stribeck: (n,) speed at which the Stribeck peak has decreased to 1/e [rad/s].
        power: (n,) exponent of the concave speed law sign(v)·|v|^p.
        turns: (n,) motor turns per joint turn; NaN if unknown.
    """

    length: FloatArray
    stribeck: FloatArray
    power: FloatArray
    turns: FloatArray

    def to_array(self) -> FloatArray:
        """Return the shapes as an array (4, n) for the model file."""
        return np.stack([self.length, self.stribeck, self.power, self.turns])

    @staticmethod
    def from_array(values: FloatArray) -> Shapes:
        """Return the shapes from the output of `to_array`."""
        return Shapes(*values)


@dataclass(eq=False)
class FrictionMotion:
    """Inputs of the friction columns for one series; all arrays have the shape (N, n).

    Attributes:
        q: Position [rad].
        v: Velocity [rad/s].
        transmitted: Torque through the gear from rigid body and payload, without friction [N·m].
        shapes: Nonlinear friction parameters.
        steps: Displacement since the previous sample [rad]; not needed if `given` is passed.
        celsius: Joint temperature [°C]; None if it was not recorded.
        given: Known friction states by multiple of the shortest length, as in a stream.
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
        """Return Dahl's state for `multiple` times the shortest length."""
        if self.given is not None:
            return self.given[multiple]
        if multiple not in self._states:
            assert self.steps is not None
            self._states[multiple] = dahl_states(self.steps, multiple * self.shapes.length)
        return self._states[multiple]

    @cached_property
    def speed(self) -> FloatArray:
        """Speed |v| [rad/s]."""
        return np.abs(self.v)

    @cached_property
    def load(self) -> FloatArray:
        """Magnitude of the torque through the gear [N·m]."""
        return np.abs(self.transmitted)

    @cached_property
    def z(self) -> FloatArray:
        """Dahl's state for the shortest length."""
        return self.state()

    def peak(self, width: float = 1.0) -> FloatArray:
        """Return Stribeck's exp(−|v|/vs), with vs multiplied by `width`."""
        return np.asarray(np.exp(-self.speed / (width * self.shapes.stribeck)))

    def law(self, power: FloatArray | float) -> FloatArray:
        """Return the power law sign(v)·|v|^power."""
        return np.asarray(np.sign(self.v) * self.speed**power)

    @cached_property
    def slow(self) -> FloatArray:
        """Amplitude of the ripple at the current speed, as a share of the amplitude at rest."""
        return np.asarray(np.exp(-self.speed / RIPPLE_FADES_RAD_S))

    @cached_property
    def direction(self) -> FloatArray:
        """Smoothed sign of the velocity of each joint."""
        return np.asarray(np.tanh(self.v / SENSE_RAD_S))

    @cached_property
    def warmth(self) -> FloatArray:
        """Temperature above the reference temperature [K]; 0 if unknown."""
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
"""Numbers of ripple periods per motor turn, from gear teeth (1, 2), motor poles and slots."""


def groups(*, ripple: bool, temperature: bool) -> dict[str, Columns]:
    """Return all groups of columns that a robot can have.

    Args:
        ripple: Whether the number of motor turns per joint turn is known.
        temperature: Whether joint temperatures were recorded.
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
    """Return the names of the columns of a group."""
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
"""Groups of columns that each step adds to the friction of a joint.

The steps of the group lists were chosen on four UR10e trajectories, each held out in turn. Broad
steps of column groups that are common to all joints predict new trajectories better than a
selection of single columns.
"""


def rungs(*, ripple: bool, temperature: bool) -> list[tuple[str, ...]]:
    """Return lists of groups from the shortest to the longest, each containing the previous list.

    The function has the same arguments as `groups`.
    """
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
"""Groups whose columns increase with the torque through the gear."""

LEAST_LOAD = 0.2
"""Smallest relative gear torque of a joint for which the groups in `LOADED` are used.

The relative gear torque is the RMS of the gear torque divided by the RMS of the torque that the
rigid body does not explain. If the relative gear torque is smaller, the coefficients of these
groups would be arbitrary at larger loads. For wrist joints 2 and 3 of a UR10e, the relative gear
torque is a tenth or less.
"""

PARTS = {"ripple": "ripple", "drive": "drive"}
"""Effort component for the first word of a group name; all other groups belong to the friction."""


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """Torque of friction, ripple and drive effects for each joint.

    Attributes:
        chosen: List of the groups of each joint, in the order of their coefficients.
        coefficients: Coefficients of the columns of each joint.
        shapes: Nonlinear friction parameters.
        celsius: (n,) typical joint temperature in training [°C], used if the temperature is
            unknown.
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
        """Return the law from a flat array of all coefficients, joint by joint.

        Raises:
            KeyError: A named group does not exist.
            ValueError: The number of coefficients or joints does not match the groups.
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
        """Return the components `friction`, `ripple` and `drive` of the law, each (N, n) [N·m]."""
        found: dict[str, FloatArray] = {"friction": np.zeros_like(motion.v)}
        for name, weights in self._weights.items():
            part = PARTS.get(name.split()[0], "friction")
            torque = found.setdefault(part, np.zeros_like(motion.v))
            for column, weight in zip(self._library[name](motion), weights, strict=True):
                torque += column * weight
        return found

    def break_away(self) -> FloatArray:
        """Return (n,) the friction [N·m] that an unloaded static joint can hold.

        At rest, the speed-dependent terms are zero and only the friction states contribute. A joint
        starts to slide when all of its friction states are saturated. The mean of the two
        directions is used, in which offset and asymmetry cancel. If friction depends on the joint
        angle, the smallest friction over the angle is returned.
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
        """Return the names of all coefficients, joint by joint."""
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
        """Coefficients of every joint by group and column; 0 for joints that lack the group."""
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
        """Return the number of columns, and thus coefficients, of a group.

        Raises:
            KeyError: The group does not exist.
        """
        probe = np.zeros((1, len(self.chosen)))
        states = dict.fromkeys(MULTIPLES, probe)
        motion = FrictionMotion(probe, probe, probe, self.shapes, given=states)
        return len(self._library[name](motion))


def predicted_friction(
    law: FrictionLaw, data: Dataset, transmitted: FloatArray, filters: FilterSettings
) -> dict[str, FloatArray]:
    """Return the filtered components of the friction law, each (N, n) [N·m].

    The components are filtered like the velocity.

    Args:
        law: Fitted friction law.
        data: Dataset that was prepared with `filters`.
        transmitted: (N, n) torque through the gears [N·m].
        filters: Filter settings; the predicted friction is filtered with the cut-off of the
            velocity.
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
    """Yield the conditions, the rows and the motion of every series that is not empty.

    Args:
        dataset: Prepared dataset.
        steps: (N, n) output of `path_steps` [rad].
        transmitted: (N, n) torque through the gears [N·m].
        shapes: Nonlinear friction parameters.
        usual: (n,) joint temperatures [°C] for rows without a recorded temperature.
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
    """Return (N, n) the joint temperatures [°C]; `usual` replaces missing values."""
    recorded = dataset.columns.get("temperature")
    if usual is None:
        return recorded
    if recorded is None:
        return np.broadcast_to(usual, dataset["q"].shape)
    return np.where(np.isfinite(recorded), recorded, usual)


def usual_temperatures(dataset: Dataset) -> FloatArray | None:
    """Return (n,) the median joint temperatures [°C]; None if a value is missing."""
    recorded = dataset.columns.get("temperature")
    if recorded is None or not len(recorded) or not np.all(np.isfinite(recorded)):
        return None
    return np.asarray(np.median(recorded, axis=0))


def temperatures_vary(dataset: Dataset) -> bool:
    """Return whether joint temperatures were recorded and vary by 1 K or more in some joint."""
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
    """Return the low-pass-filtered columns (N, …) of one series; unchanged for a static arm.

    Args:
        values: Columns to be filtered, with one row per sample.
        condition: Recorded conditions of the series.
        t: (N,) time [s].
        settings: Filter settings with the order and unit of the filter.
        cutoff: Cut-off of the filter; None for the cut-off of the effort.
    """
    if condition.kind in AT_REST:
        return values
    chosen = settings.effort if cutoff is None else cutoff
    fraction = nyquist_fraction(chosen, settings.unit, sample_rate(t))
    return zero_phase(values, fraction, settings.order)
