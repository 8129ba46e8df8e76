"""What a controller computes every cycle, as plain arrays free of the estimator that found it.

    torque = rigid body and load + friction, or Lagrangian network + load + friction
    effort = torque / scale + correction

`program_of` reads a `Program` from a fitted model; C, PyTorch and ONNX are written from it. Bodies
need not be able to exist: they are one set that has the base parameters of the model.

Friction is of one of four kinds: `PlainFriction`, `ShapedFriction`, `NetworkFriction`, or a
`FrictionLaw` of the friction library, whose columns `GROUPS` has. Weights of networks are laid out
for programs here too, so that none of them needs torch to be written (`LagrangianTerms`,
`CellWeights`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hil.core import FitError, FloatArray
from hil.dynamics import JointGeometry, RobotModel, base_parameters
from hil.estimators import (
    FORMS,
    LEAST_SPEED,
    MULTIPLES,
    NARROWEST,
    ORDERS,
    TERMS,
    FrictionLaw,
    RigidDiffnea,
    RigidHysteresis,
    RigidLinear,
    RobotEstimator,
    StaticModel,
)
from hil.networks import (
    Activation,
    Correction,
    FrictionKind,
    LagrangianEstimator,
    ResidualNetwork,
    TrainedTcn,
)


@dataclass(frozen=True, slots=True, eq=False)
class PlainFriction:
    """Coulomb and viscous friction with a smooth sign, and a constant.

    Attributes:
        coulomb: (n,) [N·m].
        viscous: (n,) [N·m·s/rad].
        offset: (n,) [N·m].
        sign_width: Of tanh(qd/width) [rad/s]; 0 for the hard sign.
        exponent: (n,) of the viscous part, see `hil.estimators.friction_curve.power_of_speed`.
        power_width: Of that [rad/s].
    """

    coulomb: FloatArray
    viscous: FloatArray
    offset: FloatArray
    sign_width: float
    exponent: FloatArray
    power_width: float


@dataclass(frozen=True, slots=True, eq=False)
class ShapedFriction:
    """Friction that a few numbers per joint shape: Stribeck's peak, a power of the speed, memory.

        friction = d·[Fc + (Fs − Fc)·exp(−(u/vs)^δ) + g·|τ|] + p·Fp·u^α + Fv·q̇ + offset
                 + z₁₀·(m + mg·|τ|)

    with u the speed, d the direction, p the direction of the power and τ the torque through the
    gear. Coefficients are 0 where a term is not there; `rigid-diffnea` and `lagrangian` have forms
    that differ in that.

    Attributes:
        coulomb, static: Fc, Fs (n,) [N·m].
        stribeck_speed: vs (n,) [rad/s].
        stribeck_exponent: δ (n,).
        power: Fp (n,) [N·m].
        exponent: α (n,).
        viscous: Fv (n,) [N·m·s/rad].
        offset: (n,) [N·m].
        sign_width: Of tanh(q̇/width) [rad/s]; 0 for the hard sign.
        least_speed: Speeds count as this at least [rad/s].
        more_speed: Added to speeds before that [rad/s]; one of both is above 0.
        length: (n,) in which Dahl's state comes round, which is the direction then [rad]; None for
            the sign, without memory.
        power_remembers: The direction of the power is Dahl's state too, not the sign.
        load: g (n,).
        far, far_load: m [N·m] and mg (n,), of a state with ten times the length.
    """

    coulomb: FloatArray
    static: FloatArray
    stribeck_speed: FloatArray
    stribeck_exponent: FloatArray
    power: FloatArray
    exponent: FloatArray
    viscous: FloatArray
    offset: FloatArray
    sign_width: float
    least_speed: float
    more_speed: float
    load: FloatArray
    far: FloatArray
    far_load: FloatArray
    length: FloatArray | None = None
    power_remembers: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Fully connected layers, the last one linear.

    Attributes:
        weights: Per layer (outputs, inputs).
        biases: Per layer (outputs,).
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]


Kind = Literal["float", "double"]


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


@dataclass(frozen=True, slots=True, eq=False)
class LagrangianTerms:
    """τ = M(q)·q̈ + C(q, q̇)·q̇ + g(q) of one network, see `hil.networks.lagrangian`.

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
class Program:
    """A model as arithmetic.

    Attributes:
        estimator: What found it.
        joint_names: n of them.
        effort_kind: `current` or `torque`: what comes out.
        geometry: Where the joints are.
        gravity: (3,) in the base frame [m/s²].
        flange: (4, 4) pose of the flange in the last joint's frame; loads are told in the flange's.
        rigid: (n, 11) per link: a body in the joint's frame, and the rotor's inertia. Zeros where
            a Lagrangian network stands for them.
        gears: (n, 11) the same for the torque that the gears transmit, on which friction depends.
        friction: With or without memory.
        scale: (n,) torque per unit of effort.
        correction: Of a residual network, in effort units.
        lagrangian: Network that takes the place of the rigid body; loads stay bodies.
        coupling: (n, n) T of joints = T · motors where a motor moves more than one joint, else
            None. Samples and efforts are the motors' then: bodies and load hold Tᵀ times what the
            joints at T q, T q̇, T q̈ hold; rotors, friction, networks and scale are the motors'.
    """

    estimator: str
    joint_names: tuple[str, ...]
    effort_kind: str
    geometry: JointGeometry
    gravity: FloatArray
    flange: FloatArray
    rigid: FloatArray
    gears: FloatArray
    friction: PlainFriction | FrictionLaw | ShapedFriction | NetworkFriction
    scale: FloatArray
    correction: Correction | None = None
    lagrangian: LagrangianTerms | None = None
    coupling: FloatArray | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def remembers(self) -> bool:
        """Whether what comes out depends on samples before."""
        carried = getattr(self.friction, "length", None) is not None
        return carried or isinstance(self.friction, FrictionLaw) or self.correction is not None


BODY = 10
"""Parameters of a body in `hil.dynamics.inertial`'s order; the rotor's inertia comes behind."""


def program_of(model: RobotEstimator) -> Program:
    """What the model computes, as arithmetic.

    Raises:
        NotExported: It is of a kind that is not exported.
        FitError: It is not fitted.
    """
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    if isinstance(model, ResidualNetwork):
        return _corrected(model)
    if isinstance(model, RigidHysteresis):
        base = base_parameters(model.robot_, rotor=True)
        rigid, gears = (base.expand(beta) for beta in (model.rigid_, model.gear_rigid_))
        return _program_with(model, rigid, gears, model.law_)
    if isinstance(model, LagrangianEstimator):
        nothing = np.zeros((BODY + 1) * model.robot_.n)
        program = _program_with(model, nothing, nothing, lagrangian_friction(model))
        return replace(program, lagrangian=lagrangian_terms(model))
    if isinstance(model, RigidDiffnea):
        base = base_parameters(model.robot_, rotor=True)
        own = model.coefficients_[: base.rank]
        rigid, gears = (base.expand(beta) for beta in (own, model.gear_rigid_))
        return _program_with(model, rigid, gears, shaped_of(model))
    if isinstance(model, RigidLinear):
        n = model.robot_.n
        beta, friction = np.split(model.coefficients_, [-len(TERMS) * n])
        rigid = base_parameters(model.robot_, rotor=True).expand(beta)
        coulomb, viscous, offset = friction.reshape(n, len(TERMS)).T
        exponent = np.broadcast_to(getattr(model, "exponent_", np.ones(n)), (n,))
        width = model.sign_width or NARROWEST
        plain = PlainFriction(coulomb, viscous, offset, model.sign_width, exponent, width)
        return _program_with(model, rigid, rigid, plain)
    if isinstance(model, StaticModel):
        raise NotExported(
            f"{model.estimator} says what an arm needs at rest, a program what it needs in motion",
            hint="guide by hand with hil.control.HandGuiding, which takes this model "
            "as it is; take its parameters with --to json; or fit rigid-hysteresis to trajectories",
        )
    raise NotExported(
        f"{model.estimator} cannot be exported as a program",
        hint="export a rigid-body model (rigid-hysteresis, rigid-wls, …), lagrangian, or residual "
        "on one of them",
    )


def _corrected(model: ResidualNetwork) -> Program:
    inner = program_of(model.base_)
    correction = model.correction_
    if not np.any(correction.kept):
        return replace(inner, estimator=model.estimator)
    if correction.settings.inputs != "motion":
        raise NotExported(
            f"the residual network has inputs: {correction.settings.inputs}, so it needs the "
            "torque that a controller wants predicted",
            hint="fit residual with inputs: motion",
        )
    return replace(inner, estimator=model.estimator, correction=correction)


def _program_with(
    model: RobotEstimator,
    rigid: FloatArray,
    gears: FloatArray,
    friction: PlainFriction | FrictionLaw | ShapedFriction | NetworkFriction,
) -> Program:
    robot = model.robot_
    return Program(
        estimator=model.estimator,
        joint_names=model.joint_names_,
        effort_kind=model.effort_kind_,
        geometry=robot.joint_geometry(),
        gravity=np.asarray(robot.gravity_vector, dtype=np.float64),
        flange=flange_in_last_joint(robot),
        rigid=bodies(rigid, robot.n),
        gears=bodies(gears, robot.n),
        friction=friction,
        scale=model.torque_scale_,
        coupling=getattr(robot, "joints_per_motor", None),
    )


class NotExported(FitError):
    """The model is of a kind that no program can be written of."""


def bodies(full: FloatArray, n: int) -> FloatArray:
    """(n, 11) per link from full parameters (11n,) in the order of the regressor's columns."""
    return np.column_stack([full[: BODY * n].reshape(n, BODY), full[BODY * n :]])


def terms_of(law: FrictionLaw) -> tuple[Mapping[str, FloatArray], ...]:
    """Per joint, its groups' coefficients by the name of the group."""
    found = []
    for names, flat in zip(law.chosen, law.coefficients, strict=True):
        counts = [law.count(name) for name in names]
        pieces = np.split(flat, np.cumsum(counts)[:-1])
        found.append(dict(zip(names, pieces, strict=True)))
    return tuple(found)


def flange_in_last_joint(robot: RobotModel) -> FloatArray:
    """(4, 4) pose of the flange in the frame of the last joint; it does not depend on q."""
    last = np.eye(4)
    for place in robot.joint_geometry().placement:
        last = last @ place
    flange = robot.flange_pose(np.zeros((1, robot.n)))[0]
    return np.asarray(np.linalg.solve(last, flange))


def shaped_of(model: RigidDiffnea) -> PlainFriction | ShapedFriction:
    """Friction of a fitted `rigid-diffnea`."""
    n, form = model.robot_.n, FORMS[model.friction]
    own = model.coefficients_[len(model.gear_rigid_) :]
    count = len(form.terms)
    values = dict(zip(form.terms, own[: n * count].reshape(n, count).T, strict=True))
    names = [shape.name for shape in form.shapes]
    shapes = dict(zip(names, own[n * count :].reshape(n, -1).T, strict=True))
    none, one = np.zeros(n), np.ones(n)
    width = model.sign_width
    if not shapes:
        coulomb, viscous, offset = (values[term] for term in form.terms)
        return PlainFriction(coulomb, viscous, offset, width, one, width or 1.0)
    # Without memory the exponent replaces what is viscous; with it the power is a term of its own.
    powered = "speed_exponent" in shapes and "speed" not in values
    return ShapedFriction(
        coulomb=values["coulomb"],
        static=values["static"],
        stribeck_speed=shapes["stribeck_velocity"],
        stribeck_exponent=shapes.get("stribeck_exponent", one),
        power=values["viscous"] if powered else values.get("speed", none),
        exponent=shapes.get("speed_exponent", one),
        viscous=none if powered else values["viscous"],
        offset=values["offset"],
        sign_width=width,
        least_speed=0.0,
        more_speed=LEAST_SPEED,
        load=values.get("load", none),
        far=values.get("memory", none),
        far_load=values.get("memory_load", none),
        length=shapes.get("dahl_length"),
    )


LEAST_NETWORK_REST_SPEED, LEAST_NETWORK_SPEED = 1e-4, 1e-6
"""As the friction of `hil.networks.lagrangian` has them, which torch is needed to read."""


def lagrangian_terms(model: LagrangianEstimator) -> LagrangianTerms:
    """Those of a fitted `lagrangian`."""
    from hil.networks import network_of

    settings = model.design_.network
    of_factor = settings.epsilon_of == "factor"
    dynamics = network_of(model.design_, model.torque_std_, model.weights_).dynamics
    # An entry of L's diagonal stands alone in its row of the placement.
    unit = dynamics.factor.placement[: model.robot_.n].sum(dim=-1).double().numpy()
    names = [f"dynamics.trunk.layers.{i}" for i in range(len(settings.hidden))]
    return LagrangianTerms(
        trunk=_layers_of(model.weights_, [*names, "dynamics.trunk.last"]),
        kind=_precision_of(model.weights_),
        activation=settings.activation,
        sincos=settings.features == "sincos",
        rectified=settings.diagonal == "relu",
        least=settings.epsilon if of_factor else 0.0,
        added=0.0 if of_factor else settings.epsilon,
        unit=unit,
        potential=settings.gravity == "potential",
        gravity_unit=dynamics.gravity_unit.double().numpy(),
    )


def _layers_of(weights: Mapping[str, np.ndarray[Any, Any]], names: list[str]) -> Layers:
    def all_of(what: str) -> tuple[FloatArray, ...]:
        return tuple(np.asarray(weights[f"{name}.{what}"], dtype=np.float64) for name in names)

    return Layers(all_of("weight"), all_of("bias"))


def _precision_of(weights: Mapping[str, np.ndarray[Any, Any]]) -> Kind:
    doubled = any(value.dtype == np.float64 for value in weights.values())
    return "double" if doubled else "float"


def lagrangian_friction(
    model: LagrangianEstimator,
) -> PlainFriction | ShapedFriction | NetworkFriction:
    """Friction of a fitted `lagrangian`."""
    kind: FrictionKind = model.design_.kind
    if kind in ("dissipative", "unconstrained"):
        return _network_friction(model)
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
        least_speed=LEAST_NETWORK_SPEED,
        more_speed=0.0,
        load=none,
        far=none,
        far_load=none,
        length=length,
        power_remembers=True,
    )


def _network_friction(model: LagrangianEstimator) -> NetworkFriction:
    weights, settings = model.weights_, model.design_.friction
    names = [f"friction.network.{2 * i}" for i in range(len(settings.hidden) + 1)]
    return NetworkFriction(
        layers=_layers_of(weights, names),
        kind=_precision_of(weights),
        dissipative=model.design_.kind == "dissipative",
        scale=np.asarray(weights["friction.scale"], dtype=np.float64),
        rest_speed=max(settings.rest_speed, LEAST_NETWORK_REST_SPEED),
    )


LONG = 10.0
"""Length of the second state of a `ShapedFriction`, as a multiple of the first's."""

BLOCK = 4
"""Channels and inputs are filled up to a multiple with zeros: loops go by so many at once."""


@dataclass(frozen=True, slots=True, eq=False)
class CellWeights:
    """S sets of F inputs, E cells of W channels, L layers of K taps, O outputs of each cell.

    A cell is the network of one branch and fold, of one kept joint in layout `grouped` and of all
    in `joint`. All cells read a set of inputs; the branches share it.

    F and W are multiples of `BLOCK`; what was added weighs nothing. Products over channels have
    the channels that come out last, so that neighbours are computed together.

    Attributes:
        means, rates, lowest, highest: (S, F) of the inputs: to subtract, to multiply by, the range.
        enter, enter_bias: (E, F·W) and (E, W).
        taps, biases: (L·E, K·W·W), the oldest tap first, and (L·E, W).
        leave, leave_bias: (E·O, W) and (E·O,).
        share: (E·O,) what an output counts for in the mean [effort unit].
        joints: (E·O,) whose effort it is.
    """

    means: FloatArray
    rates: FloatArray
    lowest: FloatArray
    highest: FloatArray
    enter: FloatArray
    enter_bias: FloatArray
    taps: FloatArray
    biases: FloatArray
    leave: FloatArray
    leave_bias: FloatArray
    share: FloatArray
    joints: NDArray[np.intp]


def cell_weights(correction: Correction) -> CellWeights:
    """Those of the kept joints; at least one is kept."""
    kept = np.flatnonzero(correction.kept)
    own = correction.settings.layout == "grouped"
    groups = kept if own else np.array([0])
    sets = [(network, group) for network in correction.networks for group in groups]
    cells = [
        _cell(network, int(group), branch, kept)
        for network, group in sets
        for branch in range(len(network.scale))
    ]
    layers = range(len(correction.settings.dilations))
    ranges = [_range(network, int(group)) for network, group in sets]
    means, rates, lowest, highest = (np.stack(some) for some in zip(*ranges, strict=True))
    outputs = [np.array([group]) if own else kept for _, group in sets]
    branches = correction.settings.branches
    return CellWeights(
        means=means,
        rates=rates,
        lowest=lowest,
        highest=highest,
        enter=np.stack([cell.enter for cell in cells]),
        enter_bias=np.stack([cell.enter_bias for cell in cells]),
        taps=np.stack([cell.taps[layer] for layer in layers for cell in cells]),
        biases=np.stack([cell.biases[layer] for layer in layers for cell in cells]),
        leave=np.concatenate([cell.leave for cell in cells]),
        leave_bias=np.concatenate([cell.leave_bias for cell in cells]),
        share=np.concatenate([cell.share for cell in cells]) / len(correction.networks),
        joints=np.concatenate([joints for joints in outputs for _ in range(branches)]),
    )


def _cell(network: TrainedTcn, group: int, branch: int, kept: NDArray[np.intp]) -> _Cell:
    weights, n = network.weights, network.n
    own = network.settings.layout == "grouped"
    at = branch * (n if own else 1) + group
    outputs = np.array([0]) if own else kept
    return _Cell(
        enter=filled(weights.enter[at].T, 0, 1).ravel(),
        enter_bias=filled(weights.enter_bias[at], 0),
        taps=[filled(taps[at].transpose(2, 1, 0), 1, 2).ravel() for taps in weights.taps],
        biases=[filled(bias[at], 0) for bias in weights.biases],
        leave=filled(weights.leave[at][outputs], 1),
        leave_bias=np.asarray(weights.leave_bias[at][outputs], dtype=np.float64),
        share=network.scale[branch][[group] if own else kept],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Cell:
    enter: FloatArray
    enter_bias: FloatArray
    taps: list[FloatArray]
    biases: list[FloatArray]
    leave: FloatArray
    leave_bias: FloatArray
    share: FloatArray


def _range(network: TrainedTcn, group: int) -> Iterator[FloatArray]:
    """Means, rates, lowest and highest of a set of inputs, in `NetworkInputs`' order."""
    scales, settings = network.inputs.scales, network.settings
    zero = np.zeros(network.n)
    if settings.layout == "joint":
        mean = np.column_stack([scales.q_mean, zero, zero]).ravel()
        scale = np.column_stack([scales.q, scales.qd, scales.qdd]).ravel()
    else:
        # Signs are what they are.
        signs = len(settings.sign_widths)
        at = [group] if settings.base_input else []
        mean = np.r_[np.zeros(2 + signs), scales.base_mean[at]]
        base = scales.base[at]
        scale = np.r_[scales.qd[group], np.ones(signs), scales.qdd[group], base]
    for values in (mean, 1.0 / scale, scales.lowest[group], scales.highest[group]):
        yield filled(values, 0)


def filled(values: NDArray[np.float32] | FloatArray, *axes: int) -> FloatArray:
    """Zeros behind the values, up to a multiple of `BLOCK` along the axes."""
    behind = [(0, -size % BLOCK if axis in axes else 0) for axis, size in enumerate(values.shape)]
    return np.pad(np.asarray(values, dtype=np.float64), behind)


GROUPS: Mapping[str, tuple[str, ...]] = {
    "core": ("1.0", "v", "z1"),
    "load": ("z1 * load",),
    "stribeck": ("z1 * peak1",),
    "stribeck narrow": ("z1 * peak03",),
    "stribeck wide": ("z1 * peak3",),
    "stribeck load": ("z1 * peak1 * load",),
    "stribeck wide load": ("z1 * peak3 * load",),
    "stribeck memory": ("z10 * peak03",),
    "braking": ("fabs(z1) * tau",),
    "drive": ("tau * load",),
    **{f"memory {k:g}": (f"z{k:g}",) for k in MULTIPLES[1:]},
    **{f"memory {k:g} load": (f"z{k:g} * load",) for k in MULTIPLES[1:]},
    "speed p": ("law_p",),
    "speed 0.25": ("law025",),
    "speed 0.5": ("law05",),
    "speed 1.5": ("law15",),
    "speed 2": ("v * speed",),
    "speed p load": ("law_p * load",),
    "speed 1 load": ("v * load",),
    "speed 2 load": ("v * speed * load",),
    "asymmetry": ("speed",),
    "dry asymmetry": ("fabs(z1)",),
    "speed braking": ("speed * tau",),
    **{f"turn {k}": (f"jsin{k}", f"jcos{k}") for k in (1, 2)},
    **{f"turn {k} dry": (f"z1 * jsin{k}", f"z1 * jcos{k}") for k in (1, 2)},
    **{f"ripple {k}": (f"sin{k}", f"cos{k}") for k in ORDERS},
    **{f"ripple {k} slow": (f"slow * sin{k}", f"slow * cos{k}") for k in ORDERS},
    **{f"ripple {k} sign": (f"sense * sin{k}", f"sense * cos{k}") for k in ORDERS},
    **{
        f"ripple {k} slow sign": (f"slow * sense * sin{k}", f"slow * sense * cos{k}")
        for k in ORDERS
    },
    "temperature": ("z1 * warmth", "law_p * warmth"),
}
"""Group of the friction library → its columns as C expressions.

They are expressions of what a joint has at this sample: `v`, `speed` = |v|, `z3` (Dahl's state of
three times the shortest length), `tau` (torque through the gear) and `load` = |tau|, `peak03`
(Stribeck's exponential, 0.3 as wide), `law025` (sign(v)·|v|^0.25), `sin4`, `cos4` (four times per
motor turn), `jsin1` (once per joint turn).
"""

PEAKS = {"peak03": 0.3, "peak1": 1.0, "peak3": 3.0}
LAWS = {"law025": 0.25, "law05": 0.5, "law15": 1.5}
