"""Program as a PyTorch module that processes one sample of many independent streams at once.

`ProgramModule` consists of a module for the rigid body or a Lagrangian network (`RigidTorque`,
`LagrangianTorque`), a module for friction (`PlainLaw`, `ShapedLaw`, `NetworkLaw`, `MemoryLaw`) and
a module for a residual network (`StreamingTcn`). The state of a module is both an input and an
output; its initial value is zero, and `parts` lists its components. The modules use no in-place
operations, no scatter, no gather and no branches, so that they can be traced for small runtimes.

All computations except those of networks are in double precision. Networks use single precision,
independent of the training precision, because some runtimes lack some network functions in double
precision.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import groupby
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.core import FloatArray
from hil.dynamics import pseudo_inertia, skew
from hil.estimators import (
    MULTIPLES,
    REFERENCE_C,
    RIPPLE_FADES_RAD_S,
    SENSE_RAD_S,
    FrictionLaw,
    RobotEstimator,
)
from hil.export.exported import effort_unit
from hil.export.program import (
    GROUPS,
    LAWS,
    LONG,
    PEAKS,
    CellWeights,
    LagrangianTerms,
    NetworkFriction,
    PlainFriction,
    Program,
    ShapedFriction,
    cell_weights,
    program_of,
    terms_of,
)
from hil.networks import Correction, LagrangianNetwork, NetworkSettings

LOAD_UNITS = ("kg", *["m"] * 3, *["kg*m2"] * 6)
"""Units of mass, centre of mass x y z, and inertia about the centre of mass xx yy zz xy xz yz."""

SINGLE = torch.float32
"""Number type of the networks."""

SLOWEST = 1e-12
"""Speed [rad/s] below which a power of the speed is set to 0, to avoid the logarithm of 0."""

LARGEST_EXPONENT = 20.0
"""Maximum of exponents, which avoids overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class TorchModel:
    """PyTorch module with the information that is needed to call the module.

    Attributes:
        module: PyTorch module in double precision and evaluation mode, which returns a tuple:
            effort[, state_next] = module(q, qd, qdd, load[, state]); see `ProgramModule`.
        estimator: Name of the estimator.
        joint_names: Names of the n joints.
        effort_kind: Kind of the effort: `current` or `torque`.
        turns: Whether each joint is revolute; joints that are not revolute are prismatic.
        state: Name and size of each component of the state, in the order of the state; empty for a
            module without memory.
        rate_hz: Sample rate of the training data of the residual network [Hz]; None if any rate is
            valid.
    """

    module: nn.Module
    estimator: str
    joint_names: tuple[str, ...]
    effort_kind: str
    turns: tuple[bool, ...]
    state: tuple[tuple[str, int], ...] = ()
    rate_hz: float | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def state_size(self) -> int:
        """Size S of the state; 0 for a module without memory."""
        return sum(size for _, size in self.state)

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the inputs and of the outputs of the module."""
        inputs, outputs = ("q", "qd", "qdd", "load"), ("effort",)
        return ((*inputs, "state"), (*outputs, "state_next")) if self.state else (inputs, outputs)

    @property
    def units(self) -> dict[str, list[str]]:
        """Units of every column of the inputs and of the effort, in ASCII."""
        lengths = ["rad" if turns else "m" for turns in self.turns]
        of_torque = ["N*m" if turns else "N" for turns in self.turns]
        return {
            "q": lengths,
            "qd": [f"{one}/s" for one in lengths],
            "qdd": [f"{one}/s2" for one in lengths],
            "load": list(LOAD_UNITS),
            "effort": of_torque if self.effort_kind == "torque" else ["A"] * self.n,
        }

    def metadata(self) -> dict[str, str]:
        """Return metadata for a file: plain text, with lists as JSON."""
        return {
            "written_by": "hil",
            "estimator": self.estimator,
            "joint_names": json.dumps(self.joint_names),
            "units": json.dumps(self.units),
            "effort_unit": effort_unit(self.effort_kind).replace("·", "*"),
            "state_size": str(self.state_size),
            "state": json.dumps(self.state),
            "rate_hz": "" if self.rate_hz is None else f"{self.rate_hz:.9g}",
        }


def module_of(model: RobotEstimator) -> TorchModel:
    """Return the computation of a model as a PyTorch module.

    Raises:
        FitError: The model is not fitted, or its estimator cannot be exported.
    """
    program = program_of(model)
    module = ProgramModule(program).eval()
    correction = program.correction if module.network is not None else None
    return TorchModel(
        module=module,
        estimator=program.estimator,
        joint_names=program.joint_names,
        effort_kind=program.effort_kind,
        turns=tuple(bool(turns) for turns in program.geometry.turns),
        state=module.parts,
        rate_hz=None if correction is None else correction.networks[0].rate_hz,
    )


Carried = dict[str, Tensor]
"""Mapping from the name of a state component to its values (B, size)."""


class ProgramModule(nn.Module):
    """Module for effort[, state_next] = module(q, qd, qdd, load[, state]) in double precision.

    The module is differentiable in q, qd, qdd and the state, except for the signs in the friction.
    The module uses no in-place operations.

    Args:
        program: Program that the module computes; networks that no joint uses are ignored.

    Attributes:
        parts: Name and size of each component of the state, in the order of the state; empty
            without memory.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.physics = physics_module(program)
        self.friction = friction_module(program)
        self.network = network_module(program)
        register_constants(self, scale=program.scale)
        carried = self.friction.parts + (self.network.parts if self.network is not None else ())
        self.parts: tuple[tuple[str, int], ...] = (("begun", 1), *carried) if carried else ()

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Return (effort,) for a program without memory, or (effort, state_next) with memory.

        Args:
            q: (B, n) position [rad].
            qd: (B, n) velocity [rad/s].
            qdd: (B, n) acceleration [rad/s²].
            load: (B, 10) mass [kg], centre of mass [m] in the flange frame, inertia about the
                centre of mass (xx, yy, zz, xy, xz, yz) [kg·m²].
            state: (B, S) state after the previous sample; zeros for the first sample. For a program
                without memory, `state` is None.
        """
        torque, gears = self.physics(q, qd, qdd, load)
        carried, begun = self._carried(state)
        friction, held = self.friction(q, qd, gears, begun, carried)
        effort = (torque + friction) / self.scale
        after = dict(carried) | held
        if self.network is not None:
            added, rings = self.network(q, qd, qdd, effort, begun, carried)
            effort, after = effort + added, after | rings
        if not self.parts:
            return (effort,)
        after["begun"] = torch.clamp(carried["begun"], min=1.0)
        return effort, torch.cat([after[name] for name, _ in self.parts], dim=1)

    def _carried(self, state: Tensor | None) -> tuple[Carried, Tensor | None]:
        """Return the state by component, and (B, 1) whether there was a previous sample."""
        if state is None:
            return {}, None
        names, sizes = zip(*self.parts, strict=True)
        carried = dict(zip(names, state.split(sizes, dim=1), strict=True))
        return carried, carried["begun"] > 0.5


def physics_module(program: Program) -> nn.Module:
    """Return the module from (q, qd, qdd, load) to torque and gear torque, each (B, n) [N·m]."""
    if program.lagrangian is not None:
        return LagrangianTorque(program, program.lagrangian)
    return RigidTorque(program)


class FrictionModule(Protocol):
    """Module for friction.

    Attributes:
        parts: Name and size of each component of the module's state, which starts at zero; empty
            without memory.
    """

    parts: tuple[tuple[str, int], ...]

    def __call__(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the friction torque (B, n) [N·m], and the changed components of the state.

        Args:
            q: (B, n) position [rad].
            qd: (B, n) velocity [rad/s].
            gears: (B, n) torque that the gears transmit [N·m].
            begun: (B, 1) whether there was a previous sample; None for a module without memory.
            carried: Values of the state components that `parts` lists. `warmer_k` (B, n) is the
                joint temperature minus the temperature in training [K].
        """


def friction_module(program: Program) -> FrictionModule:
    """Return the module for the program's kind of friction."""
    friction = program.friction
    if isinstance(friction, PlainFriction):
        return PlainLaw(friction)
    if isinstance(friction, ShapedFriction):
        return ShapedLaw(friction)
    if isinstance(friction, NetworkFriction):
        return NetworkLaw(friction)
    return MemoryLaw(friction)


def network_module(program: Program) -> StreamingTcn | None:
    """Return the residual networks; None if no joint uses them."""
    correction = program.correction
    if correction is None or not np.any(correction.kept):
        return None
    return StreamingTcn(correction)


class RigidTorque(nn.Module):
    """Torques of all links and the load, linear in inertial parameters, for all links at once.

    With link poses Tᵢ and joint twists Gᵢ (4×4), both in the base frame, the velocity of a link is
    V = Σ G·q̇ over the joints up to the link, and its acceleration is V' = Σ (G·q̈ + [V, G]·q̇). A
    link with pseudo-inertia J requires A = (V' + V²)·T J Tᵀ, with gravity included in V'. The
    torque of a joint is τᵢ = ⟨Gᵢ, Σ A⟩ over the links that the joint carries (Uicker 1967, in the
    notation of Wensing, Kim & Slotine 2018). The torques equal those of Newton–Euler, but are
    computed without recursion from link to link. Only the poses are multiplied one after the other;
    sums along the chain are products with a triangular matrix. The number of operations, which
    determines the time per sample in a runtime, is therefore small. If motors move more than one
    joint, q, q̇, q̈, rotors and torques refer to the motors.

    Args:
        program: Program, of which geometry, gravity, flange and bodies are used.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.n = program.n
        self.slides = not np.all(program.geometry.turns)
        self.own_gears = not np.array_equal(program.gears, program.rigid)
        self.coupled = program.coupling is not None
        if program.coupling is not None:
            register_constants(self, joints=program.coupling.T, motors=program.coupling)
        register_constants(self, **_geometry(program), **_load(program))
        register_constants(self, rotors=program.rigid[:, 10])
        register_constants(self, bodies=pseudo_inertia(program.rigid[:, :10]))
        if self.own_gears:
            register_constants(self, gears=pseudo_inertia(program.gears[:, :10]))
            register_constants(self, gear_rotors=program.gears[:, 10])

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Return the torque of rigid body and load, and the torque in the gears, (B, n) [N·m].

        Args:
            q: (B, n) position [rad].
            qd: (B, n) velocity [rad/s].
            qdd: (B, n) acceleration [rad/s²].
            load: (B, 10) mass [kg], centre of mass [m] in the flange frame, inertia about the
                centre of mass (xx, yy, zz, xy, xz, yz) [kg·m²].
        """
        moves = [rows @ self.joints for rows in (q, qd, qdd)] if self.coupled else [q, qd, qdd]
        pose = self._poses(moves[0])
        twist = self._twists(pose)
        acceleration = self._acceleration(twist, *moves[1:])
        mounted = self.last * self._mounted(load)
        torque = (
            self._joint_torques(pose, twist, acceleration, self.bodies + mounted)
            + self.rotors * qdd
        )
        if not self.own_gears:
            return torque, torque
        gears = (
            self._joint_torques(pose, twist, acceleration, self.gears + mounted)
            + self.gear_rotors * qdd
        )
        return torque, gears

    def _poses(self, q: Tensor) -> Tensor:
        """Return the poses (B, n, 4, 4) of the links in the base frame."""
        angle = q.reshape(-1, self.n, 1, 1)
        step = self.still + torch.cos(angle) * self.cosine + torch.sin(angle) * self.sine
        if self.slides:
            step = step + angle * self.slide
        poses: list[Tensor] = []
        for one in step.split(1, dim=1):
            poses.append(poses[-1] @ one if poses else one)
        return torch.cat(poses, dim=1)

    def _twists(self, pose: Tensor) -> Tensor:
        """Return the joint twists (B, n, 4, 4) in the base frame, per unit of joint velocity."""
        axis = (pose @ self.turning).reshape(-1, self.n, 4)
        turn = (axis @ self.skewed).reshape(-1, self.n, 4, 4)
        twist = turn @ (self.one - pose @ self.corner)
        return twist + pose @ self.sliding if self.slides else twist

    def _acceleration(self, twist: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return V' + V² (B, n, 4, 4) of each link, with gravity subtracted."""
        v, a = (values.reshape(-1, self.n, 1, 1) for values in (qd, qdd))
        velocity = self._outwards(twist * v)
        bracket = velocity @ twist - twist @ velocity
        return self._outwards(twist * a + bracket * v) + velocity @ velocity + self.falling

    def _joint_torques(
        self, pose: Tensor, twist: Tensor, acceleration: Tensor, inertia: Tensor
    ) -> Tensor:
        wrench = acceleration @ (pose @ inertia @ pose.transpose(2, 3))
        carried = self.inwards @ wrench.reshape(-1, self.n, 16)
        torque = (twist.reshape(-1, self.n, 16) * carried).sum(dim=2)
        return torque @ self.motors if self.coupled else torque

    def _outwards(self, each: Tensor) -> Tensor:
        """Return the sums of the values over the joints up to each link."""
        return (self.outwards @ each.reshape(-1, self.n, 16)).reshape(-1, self.n, 4, 4)

    def _mounted(self, load: Tensor) -> Tensor:
        """Return the pseudo-inertia (B, 1, 4, 4) of a load in the frame of the last link."""
        about_centre = (load @ self.load_inertia).reshape(-1, 1, 4, 4)
        centre = load @ self.load_centre + self.load_origin
        mass = load[:, :1].reshape(-1, 1, 1, 1)
        return about_centre + mass * (centre.reshape(-1, 1, 4, 1) * centre.reshape(-1, 1, 1, 4))


def _geometry(program: Program) -> dict[str, FloatArray]:
    """Return the constant matrices of the joints by buffer name, as exported files contain them.

    The pose of a joint is still + cosine·cos q + sine·sin q + slide·q (Rodrigues).
    """
    n, geometry = program.n, program.geometry
    whole = np.zeros((4, n, 4, 4))
    still, cosine, sine, slide_in_joint = whole
    turning = np.zeros((n, 4, 1))
    falling = np.zeros((4, 4))
    falling[:3, 3] = -program.gravity
    last = np.zeros((n, 1, 1))
    last[-1] = 1.0
    for i, axis in enumerate(geometry.axis):
        still[i, 3, 3] = 1.0
        if geometry.turns[i]:
            along = np.outer(axis, axis)
            still[i, :3, :3], cosine[i, :3, :3], sine[i, :3, :3] = (
                along, np.eye(3) - along, skew(axis),
            )  # fmt: skip
            turning[i, :3, 0] = axis
        else:
            still[i, :3, :3], slide_in_joint[i, :3, 3] = np.eye(3), axis
    still, cosine, sine, slide_in_parent = (geometry.placement @ part for part in whole)
    skewed = np.zeros((4, 4, 4))
    skewed[:3, :3, :3] = np.array([skew(axis) for axis in np.eye(3)])
    return {
        "still": still, "cosine": cosine, "sine": sine, "slide": slide_in_parent,
        "sliding": slide_in_joint,
        "turning": turning, "skewed": skewed.reshape(4, 16), "falling": falling, "last": last,
        "one": np.eye(4), "corner": np.diag([0.0, 0.0, 0.0, 1.0]),
        "outwards": np.tril(np.ones((n, n))), "inwards": np.triu(np.ones((n, n))),
    }  # fmt: skip


def _load(program: Program) -> dict[str, FloatArray]:
    """Return matrices from a load's ten numbers to its inertia and its centre in the last link."""
    flange = program.flange
    inertia, centre = np.zeros((10, 4, 4)), np.zeros((10, 4))
    # Indices of xx, yy, zz, xy, xz, yz in the parameters of a body.
    for number, parameter in enumerate((4, 6, 9, 5, 7, 8)):
        inertia[4 + number] = flange @ pseudo_inertia(np.eye(10)[parameter]) @ flange.T
    centre[1:4] = flange[:, :3].T
    return {
        "load_inertia": inertia.reshape(10, 16),
        "load_centre": centre,
        "load_origin": flange[:, 3],
    }


class LagrangianTorque(nn.Module):
    """Torque of a Lagrangian network, plus the torque of the load by Newton–Euler.

    Args:
        program: Program whose rigid bodies are zero.
        terms: Lagrangian network.
    """

    def __init__(self, program: Program, terms: LagrangianTerms) -> None:
        super().__init__()
        self.load = RigidTorque(program)
        self.network = lagrangian_network(terms)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Return the torque and the gear torque, (B, n) [N·m], as `RigidTorque.forward`."""
        carried, _ = self.load(q, qd, qdd, load)
        found = self.network(q.to(SINGLE), qd.to(SINGLE), qdd.to(SINGLE))
        torque = found.to(torch.float64) + carried
        return torque, torque


def lagrangian_network(terms: LagrangianTerms) -> LagrangianNetwork:
    """Return the Lagrangian network for the passed terms, with frozen weights."""
    layers, n = terms.trunk, len(terms.unit)
    settings = NetworkSettings(
        hidden=tuple(len(bias) for bias in layers.biases[:-1]),
        activation=terms.activation,
        features="sincos" if terms.sincos else "raw",
        gravity="potential" if terms.potential else "head",
        diagonal="relu" if terms.rectified else "softplus",
        epsilon=terms.least or terms.added,
        epsilon_of="factor" if terms.least else "mass",
        scaled=False,
    )
    network = LagrangianNetwork(n, settings)
    network.to(SINGLE)
    linear = [*network.trunk.layers, network.trunk.last]
    with torch.no_grad():
        for layer, weight, bias in zip(linear, layers.weights, layers.biases, strict=True):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.copy_(torch.as_tensor(bias))
        network.factor.placement.mul_(torch.as_tensor(np.repeat(terms.unit, n)))
        network.gravity_unit.copy_(torch.as_tensor(terms.gravity_unit))
    network.requires_grad_(False)
    return network


class NetworkLaw(nn.Module):
    """Friction that a network computes, either dissipative or unconstrained.

    Args:
        friction: Friction network of n joints.

    Attributes:
        parts: Empty list of state components, because network friction has no memory.
    """

    parts: tuple[tuple[str, int], ...] = ()

    def __init__(self, friction: NetworkFriction) -> None:
        super().__init__()
        self.dissipative, self.rest = friction.dissipative, friction.rest_speed
        self.count = len(friction.layers.weights)
        self.n = friction.layers.weights[0].shape[1] // 3
        register_constants(self, SINGLE, scale=friction.scale)
        both = zip(friction.layers.weights, friction.layers.biases, strict=True)
        for k, (weight, bias) in enumerate(both):
            register_constants(self, SINGLE, **{f"weight{k}": weight, f"bias{k}": bias})
        if self.dissipative:
            register_constants(self, SINGLE, places=_places(self.n))

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the friction torque (B, n) [N·m] and the changed state, as `FrictionModule`."""
        q, qd = q.to(SINGLE), qd.to(SINGLE)
        speed = torch.abs(qd) + self.rest
        velocity = torch.log(speed) if self.dissipative else qd
        value = torch.cat([torch.cos(q), torch.sin(q), velocity], dim=1)
        for k in range(self.count):
            weight, bias = self.get_buffer(f"weight{k}"), self.get_buffer(f"bias{k}")
            value = functional.linear(value, weight, bias)
            value = torch.tanh(value) if k + 1 < self.count else value
        value = value * self.scale
        if not self.dissipative:
            return value.to(torch.float64), {}
        lower = (value @ self.places).reshape(-1, self.n, self.n)
        factor = lower * torch.rsqrt(speed).reshape(-1, self.n, 1)
        torque = factor @ (factor.transpose(1, 2) @ qd.reshape(-1, self.n, 1))
        return torque.reshape(-1, self.n).to(torch.float64), {}


def _places(n: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the matrix (n(n+1)/2, n²) that places the entries of a lower triangle, row by row."""
    rows, columns = np.tril_indices(n)
    found = np.zeros((len(rows), n * n))
    found[np.arange(len(rows)), rows * n + columns] = 1.0
    return found


class PlainLaw(nn.Module):
    """Friction without memory.

    Args:
        friction: Friction of n joints.

    Attributes:
        parts: Empty list of state components, because this friction has no memory.
    """

    parts: tuple[tuple[str, int], ...] = ()

    def __init__(self, friction: PlainFriction) -> None:
        super().__init__()
        self.hard = friction.sign_width == 0
        self.bent = bool(np.any(friction.exponent != 1.0))
        register_constants(
            self,
            coulomb=friction.coulomb,
            viscous=friction.viscous,
            offset=friction.offset,
            width=np.array([friction.sign_width]),
            bend=0.5 * (friction.exponent - 1.0),
            square=np.array([friction.power_width**2]),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the friction torque (B, n) [N·m] and the changed state, as `FrictionModule`."""
        sign = torch.sign(qd) if self.hard else torch.tanh(qd / self.width)
        power = qd * torch.exp(self.bend * torch.log(qd * qd + self.square)) if self.bent else qd
        return self.coulomb * sign + self.viscous * power + self.offset, {}


class MemoryLaw(nn.Module):
    """Friction, ripple and drive effects of a friction law of the library, with Dahl's states.

    Args:
        law: Friction law of n joints.

    Attributes:
        parts: Name and size of each component of the module's state, which starts at zero.
    """

    def __init__(self, law: FrictionLaw) -> None:
        super().__init__()
        offset, weights = _weights(law)
        self.n = n = len(offset)
        # Columns are sorted by their number of factors, so that equal ones are multiplied together.
        self.columns = sorted((column.split(" * ") for column in weights), key=len)
        words = {word for column in self.columns for word in column}
        words |= {word[5:-1] for word in words if word.startswith("fabs(")}
        self.multiples = tuple(k for k in MULTIPLES if f"z{k:g}" in words)
        self.has_temperature, self.has_slow, self.has_sense = (
            w in words for w in ("warmth", "slow", "sense")
        )
        self.peaks = [name for name in PEAKS if name in words]
        self.laws = [name for name in ("law_p", *LAWS) if name in words]
        waves = {word for word in words if word.lstrip("j").startswith(("sin", "cos"))}
        self.waves = sorted({word.replace("sin", "").replace("cos", "") for word in waves})
        states = (("friction", len(self.multiples) * n), ("last", n))
        self.parts = states * bool(self.multiples) + (("warmer_k", n),) * self.has_temperature
        register_constants(
            self,
            offset=offset,
            weights=np.array([weights[" * ".join(column)] for column in self.columns]),
            **self._shapes(law),
        )

    def _shapes(self, law: FrictionLaw) -> dict[str, FloatArray]:
        shapes, one = law.shapes, np.ones(self.n)
        usual = REFERENCE_C * one if law.celsius is None else law.celsius
        powers = {"law_p": shapes.power, **{name: power * one for name, power in LAWS.items()}}
        turns = np.nan_to_num(shapes.turns)
        return {
            "shortness": -1.0 / np.outer(self.multiples or (1.0,), shapes.length),
            "peak_rates": np.array([-1.0 / (PEAKS[name] * shapes.stribeck) for name in self.peaks]),
            "powers": np.array([powers[name] for name in self.laws]),
            "orders": np.array(
                [float(k.lstrip("j")) * (one if k.startswith("j") else turns) for k in self.waves]
            ),
            "warmth": np.nan_to_num(usual - REFERENCE_C),
            "slow_rate": np.array([-1.0 / RIPPLE_FADES_RAD_S]),
            "sense_rate": np.array([1.0 / SENSE_RAD_S]),
        }

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the friction torque (B, n) [N·m] and the changed state, as `FrictionModule`."""
        after: Carried = {}
        rows = [one.reshape(-1, 1, self.n) for one in (q, qd, gears)]
        known = self._factors(*rows)
        if self.multiples:
            way = torch.where(begun, q - carried["last"], 0.0)
            states = carried["friction"].reshape(-1, len(self.multiples), self.n)
            z = _dahl_step(states, way, qd, self.shortness)
            after |= {"friction": z.reshape(-1, len(self.multiples) * self.n), "last": q}
            now = _split([f"z{k:g}" for k in self.multiples], z)
            known |= now | {f"fabs({name})": torch.abs(state) for name, state in now.items()}
        if self.has_temperature:
            known["warmth"] = (self.warmth + carried["warmer_k"]).reshape(-1, 1, self.n)
        return (self._products(known) * self.weights).sum(dim=1) + self.offset, after

    def _factors(self, q: Tensor, v: Tensor, tau: Tensor) -> dict[str, Tensor]:
        """Return the factors of the columns, each (B, 1, n), without memory and temperature."""
        speed = torch.abs(v)
        known = {"v": v, "speed": speed, "tau": tau, "load": torch.abs(tau)}
        if self.peaks:
            known |= _split(self.peaks, torch.exp(speed * self.peak_rates))
        if self.laws:
            toward = torch.where(speed > SLOWEST, torch.sign(v), 0.0)
            power = torch.exp(torch.log(torch.clamp(speed, min=SLOWEST)) * self.powers)
            known |= _split(self.laws, toward * power)
        if self.waves:
            angle = q * self.orders
            for wave, values in (("sin", torch.sin(angle)), ("cos", torch.cos(angle))):
                names = [f"{'j' * k.startswith('j')}{wave}{k.lstrip('j')}" for k in self.waves]
                known |= _split(names, values)
        if self.has_slow:
            known["slow"] = torch.exp(speed * self.slow_rate)
        if self.has_sense:
            known["sense"] = torch.tanh(v * self.sense_rate)
        return known

    def _products(self, known: dict[str, Tensor]) -> Tensor:
        """Return the columns (B, C, n)."""
        found = []
        for _, group in groupby(self.columns, key=len):
            first, *others = (
                torch.cat([known[name] for name in names], dim=1)
                for names in zip(*group, strict=True)
            )
            for factor in others:
                first = first * factor
            found.append(first)
        return torch.cat(found, dim=1)


def _dahl_step(states: Tensor, way: Tensor, qd: Tensor, shortness: Tensor) -> Tensor:
    """Return Dahl's states (B, M, n) after one step.

    A displacement changes Dahl's state only if the displacement has the same sign as the velocity.

    Args:
        states: (B, M, n) values of Dahl's states before the step.
        way: (B, n) change of the positions during the step.
        qd: (B, n) velocities.
        shortness: (M, n) negative inverse length −1/length of each state [1/rad].
    """
    moved = torch.where(way * qd > 0.0, way, 0.0).reshape(-1, 1, states.shape[2])
    toward = torch.sign(moved)
    return toward + (states - toward) * torch.exp(torch.abs(moved) * shortness)


def _weights(law: FrictionLaw) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the constants (n,), and the coefficient of each joint for every other column.

    The returned coefficients belong to at least one column.
    """
    joints = terms_of(law)
    offset, weights = np.zeros(len(joints)), dict[str, FloatArray]()
    for j, terms in enumerate(joints):
        for name, found in terms.items():
            for column, weight in zip(GROUPS[name], found, strict=True):
                if column == "1.0":
                    offset[j] += weight
                else:
                    weights.setdefault(column, np.zeros(len(joints)))[j] += weight
    used = {column: weight for column, weight in weights.items() if np.any(weight)}
    return offset, used or {"v": np.zeros(len(joints))}


def _split(names: list[str], values: Tensor) -> dict[str, Tensor]:
    """Return the rows of an array (B, K, n) by name, each (B, 1, n)."""
    return dict(zip(names, values.split(1, dim=1), strict=True))


class ShapedLaw(nn.Module):
    """PyTorch module for the friction law of `hil.export.program.ShapedFriction`.

    Args:
        law: Friction law of n joints.

    Attributes:
        parts: Name and size of each component of the module's state, which starts at zero; empty
            without memory.
    """

    def __init__(self, law: ShapedFriction) -> None:
        super().__init__()
        self.n, self.width = len(law.coulomb), law.sign_width
        self.least, self.more = law.least_speed, law.more_speed
        self.remembers, self.power_remembers = law.length is not None, law.power_remembers
        self.parts: tuple[tuple[str, int], ...] = ()
        length = np.ones(self.n) if law.length is None else law.length
        if self.remembers:
            self.parts = (("friction", 2 * self.n), ("last", self.n))
        register_constants(
            self,
            coulomb=law.coulomb,
            peak=law.static - law.coulomb,
            stribeck_speed=law.stribeck_speed,
            stribeck_exponent=law.stribeck_exponent,
            power=law.power,
            exponent=law.exponent,
            viscous=law.viscous,
            offset=law.offset,
            load=law.load,
            far=law.far,
            far_load=law.far_load,
            shortness=-1.0 / np.stack([length, LONG * length]),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the friction torque (B, n) [N·m] and the changed state, as `FrictionModule`."""
        load = torch.abs(gears)
        speed = torch.clamp(torch.abs(qd) + self.more, min=self.least)
        sign = torch.tanh(qd / self.width) if self.width > 0 else torch.sign(qd)
        share = torch.exp(-_power(speed / self.stribeck_speed, self.stribeck_exponent))
        size = self.coulomb + self.peak * share + self.load * load
        law = self.power * _power(speed, self.exponent)
        plain = self.viscous * qd + self.offset
        if not self.remembers:
            return sign * (size + law) + plain, {}
        way = torch.where(begun, q - carried["last"], 0.0)
        z = _dahl_step(carried["friction"].reshape(-1, 2, self.n), way, qd, self.shortness)
        near, far = (one.reshape(-1, self.n) for one in z.split(1, dim=1))
        power_state = near if self.power_remembers else sign
        torque = near * size + power_state * law + plain + far * (self.far + self.far_load * load)
        return torque, {"friction": z.reshape(-1, 2 * self.n), "last": q}


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    return torch.exp(torch.clamp(exponent * torch.log(base), max=LARGEST_EXPONENT))


class StreamingTcn(nn.Module):
    """Mean of the networks of a correction, computed as E parallel cells of W channels.

    The networks are computed in single precision, in which they were trained. The memory of every
    layer is stored as the difference from the first sample of the stream. All values before the
    stream are assumed to equal this first sample. The initial state of the network is therefore
    zero and needs no initialisation.

    Args:
        correction: Networks whose inputs are the motion only (`inputs: motion`); at least one joint
            uses its network.

    Attributes:
        parts: Name and size of each component of the module's state, which starts at zero.
    """

    def __init__(self, correction: Correction) -> None:
        super().__init__()
        self.settings = correction.settings
        weights = cell_weights(correction)
        self.n, self.networks = len(correction.kept), len(correction.networks)
        self.own = self.settings.layout == "grouped"
        self.cells, self.width = len(weights.enter), self.settings.width
        self.sets = len(weights.means)
        signs = len(self.settings.sign_widths)
        own = 2 + signs + self.settings.base_input
        self.features = own if self.own else 3 * self.n
        self.rows = tuple((self.settings.kernel - 1) * d for d in self.settings.dilations)
        layer = self.cells * self.width
        self.parts = (
            *((f"first {k}", layer) for k in range(len(self.rows))),
            *((f"ring {k}", rows * layer) for k, rows in enumerate(self.rows)),
        )
        register_constants(self, **self._inputs(weights, correction))
        register_constants(self, SINGLE, **self._weights(weights))

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor, base: Tensor, begun: Tensor, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """Return the correction (B, n) of the effort of the physics, and the new state.

        Args:
            q: (B, n) position [rad].
            qd: (B, n) velocity [rad/s].
            qdd: (B, n) acceleration [rad/s²].
            base: (B, n) effort of the physics.
            begun: (B, 1) whether there was a previous sample.
            carried: Values of the state components that `parts` lists.
        """
        h = self._entered(self._scaled_inputs(q, qd, qdd, base))
        after: Carried = {}
        for k in range(len(self.rows)):
            now, ring = self._flat(h).double(), carried[f"ring {k}"]
            first = torch.where(begun, carried[f"first {k}"], now)
            h = self._layer(k, h, first, ring)
            after[f"first {k}"] = first
            # Drop the oldest row and append the row of this sample.
            after[f"ring {k}"] = torch.cat([ring[:, now.shape[1] :], now - first], dim=1)
        out = self._flat(torch.bmm(h, self.leave) + self.leave_bias).double()
        added = torch.minimum(torch.maximum(out @ self.share, -self.limit), self.limit)
        return added, after

    def _scaled_inputs(self, q: Tensor, qd: Tensor, qdd: Tensor, base: Tensor) -> Tensor:
        """Return the network inputs (S, B, F), scaled and clipped to the training range."""
        if self.own:
            one = [values.reshape(-1, 1, self.n) for values in (qd, qdd, base)]
            signs = torch.tanh(one[0] * self.signs)
            raw = torch.cat([one[0], signs, one[1], *one[2:][: self.settings.base_input]], dim=1)
            raw = (raw @ self.kept).transpose(1, 2)
        else:
            raw = torch.stack([q, qd, qdd], dim=2)
        raw = raw.reshape(-1, 1, self.sets // self.networks, self.features)
        scaled = (raw - self.mean) * self.rate
        held = torch.minimum(torch.maximum(scaled, self.lowest), self.highest)
        return held.reshape(-1, self.sets, self.features).float().transpose(0, 1)

    def _entered(self, seen: Tensor) -> Tensor:
        """Return the channels (E, B, W); all branches of a network have the same inputs."""
        branches = self.cells // self.sets
        h = torch.bmm(seen, self.enter).reshape(self.sets, -1, branches, self.width)
        return h.transpose(1, 2).reshape(self.cells, -1, self.width) + self.enter_bias

    def _layer(self, number: int, h: Tensor, first: Tensor, ring: Tensor) -> Tensor:
        """Return the outputs (E, B, W) of a layer for its inputs (E, B, W)."""
        rows, past_taps = self.rows[number], self.settings.kernel - 1
        old = ring.reshape(-1, rows, self.cells * self.width)
        old = old[:, :: self.settings.dilations[number]]
        old = (old + first.reshape(-1, 1, self.cells * self.width)).float()
        old = old.reshape(-1, past_taps, self.cells, self.width).permute(2, 0, 1, 3)
        seen = torch.cat([old.reshape(self.cells, -1, past_taps * self.width), h], dim=2)
        taps, bias = getattr(self, f"taps_{number}"), getattr(self, f"bias_{number}")
        total = torch.bmm(seen, taps) + bias
        return h + (torch.tanh(total) if self.settings.activation == "tanh" else torch.relu(total))

    def _flat(self, h: Tensor) -> Tensor:
        """Return (E, B, C) as (B, E·C)."""
        return h.transpose(0, 1).reshape(-1, self.cells * h.shape[2])

    def _inputs(self, weights: CellWeights, correction: Correction) -> dict[str, FloatArray]:
        shape = (1, self.networks, self.sets // self.networks, self.features)
        names = {"mean": "means", "rate": "rates", "lowest": "lowest", "highest": "highest"}
        found = {
            name: getattr(weights, of)[:, : self.features].reshape(shape)
            for name, of in names.items()
        }
        share = np.zeros((len(weights.share), self.n))
        share[np.arange(len(share)), weights.joints] = weights.share
        limit = np.where(correction.kept, correction.limit, 0.0)
        return found | {
            "share": share,
            "limit": limit,
            "signs": 1.0 / np.reshape(self.settings.sign_widths, (-1, 1)),
            "kept": np.eye(self.n)[:, correction.kept],
        }

    def _weights(self, weights: CellWeights) -> dict[str, FloatArray]:
        """Return the weights, without zero padding, as factors of products over a cell."""
        E, S, W, F, K = self.cells, self.sets, self.width, self.features, self.settings.kernel
        filled = weights.biases.shape[1]
        enter = weights.enter.reshape(E, -1, filled)[:, :F, :W]
        leave = weights.leave.reshape(E, -1, filled)[..., :W]
        taps = weights.taps.reshape(-1, E, K, filled, filled)[..., :W, :W]
        biases = weights.biases.reshape(-1, E, 1, filled)[..., :W]
        found = {
            "enter": enter.reshape(S, E // S, F, W).transpose(0, 2, 1, 3).reshape(S, F, -1),
            "enter_bias": weights.enter_bias.reshape(E, 1, filled)[..., :W],
            "leave": leave.transpose(0, 2, 1),
            "leave_bias": weights.leave_bias.reshape(E, 1, -1),
        }
        for number in range(len(self.rows)):
            found[f"taps_{number}"] = taps[number].reshape(E, K * W, W)
            found[f"bias_{number}"] = biases[number]
        return found


def register_constants(
    module: nn.Module, dtype: torch.dtype = torch.float64, /, **constants: FloatArray
) -> None:
    """Register each array as a buffer of the module, which is not a trainable parameter."""
    for name, values in constants.items():
        # An archive stores whole arrays; torch would retain the memory order of a transposed one.
        whole = np.ascontiguousarray(values)
        module.register_buffer(name, torch.tensor(whole, dtype=dtype))
