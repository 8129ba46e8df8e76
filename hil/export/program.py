"""Computation of one controller cycle with plain arrays, independent of the estimator.

    torque = rigid body and load + friction, or Lagrangian network + load + friction
    effort = torque / scale + correction

`program_of` extracts a `Program` from a fitted model. The exports to C, PyTorch and ONNX all start
from a `Program`. The bodies of a program are not necessarily physically consistent: their
parameters are one of several sets with the base parameters of the model.

The friction of a program has one of four kinds: `PlainFriction`, `ShapedFriction`,
`NetworkFriction`, or a `FrictionLaw` of the friction library, whose columns are in `GROUPS`. The
module `program` also arranges the weights of networks for the exports (`LagrangianTerms`,
`CellWeights`), so that the exports do not need torch.
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
        coulomb: (n,) Coulomb friction [N·m].
        viscous: (n,) viscous friction [N·m·s/rad].
        offset: (n,) constant [N·m].
        sign_width: Width of the smooth sign tanh(qd/width) [rad/s]; 0 for the hard sign.
        exponent: (n,) exponent of the speed in the viscous part, see
            `hil.estimators.friction_curve.power_of_speed`.
        power_width: Width in the power of the speed [rad/s].
    """

    coulomb: FloatArray
    viscous: FloatArray
    offset: FloatArray
    sign_width: float
    exponent: FloatArray
    power_width: float


@dataclass(frozen=True, slots=True, eq=False)
class ShapedFriction:
    """Friction with a few shape parameters per joint: Stribeck peak, power of the speed, memory.

        friction = d·[Fc + (Fs − Fc)·exp(−(u/vs)^δ) + g·|τ|] + p·Fp·u^α + Fv·q̇ + offset
                 + z₁₀·(m + mg·|τ|)

    In the friction formula, u is the speed, d the direction, p the direction of the power term, z₁₀
    Dahl's state with ten times the length, and τ the torque through the gear. Coefficients of
    unused friction terms are 0; `rigid-diffnea` and `lagrangian` use different terms.

    Attributes:
        coulomb, static: (n,) Coulomb friction Fc and static friction Fs [N·m].
        stribeck_speed: (n,) Stribeck speed vs [rad/s].
        stribeck_exponent: (n,) exponent δ of the Stribeck peak.
        power: (n,) coefficient Fp of the power term [N·m].
        exponent: (n,) exponent α of the power term.
        viscous: (n,) viscous friction Fv [N·m·s/rad].
        offset: (n,) constant [N·m].
        sign_width: Width of the smooth sign tanh(q̇/width) [rad/s]; 0 for the hard sign.
        least_speed: Minimum of the speed u [rad/s].
        more_speed: Speed that is added to |q̇| before the minimum is applied [rad/s]; `least_speed`
            or `more_speed` is above 0.
        length: (n,) characteristic length [rad] of Dahl's state, which is then the direction d;
            None if the sign of the velocity is the direction.
        power_remembers: Whether the direction p of the power term is also Dahl's state instead of
            the sign of the velocity.
        load: (n,) load-dependent friction g, as a share of |τ|.
        far, far_load: (n,) factors m [N·m] and mg of Dahl's state with ten times the length.
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
    """Fully connected layers, of which the last is linear.

    Attributes:
        weights: List of the weights (outputs, inputs) of each layer.
        biases: List of the biases (outputs,) of each layer.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]


Kind = Literal["float", "double"]


@dataclass(frozen=True, slots=True, eq=False)
class NetworkFriction:
    """Friction that a network of tanh layers computes from cos q, sin q and q̇.

    Attributes:
        layers: Layers whose outputs are the torques, or, for a dissipative network, the entries of
            A, row by row.
        kind: Number type in which the network was trained.
        dissipative: Whether the torque is A·Aᵀ·q̇; log(|q̇| + rest) then replaces q̇ as input.
        scale: Factor of each network output.
        rest_speed: Speed that is added to |q̇| in the logarithm (rest) [rad/s].
    """

    layers: Layers
    kind: Kind
    dissipative: bool
    scale: FloatArray
    rest_speed: float


@dataclass(frozen=True, slots=True, eq=False)
class LagrangianTerms:
    """Network for τ = M(q)·q̈ + C(q, q̇)·q̇ + g(q), see `hil.networks.lagrangian`.

    Attributes:
        trunk: Layers from features of q to raw outputs; the raw outputs are the diagonal of L, the
            rows of L below the diagonal, and V or g(q).
        kind: Number type in which the network was trained.
        activation: Activation function of the hidden layers.
        sincos: Whether the features are [cos q, sin q]; otherwise q is the feature.
        rectified: Whether the activation of the diagonal of L is max(x, 0) instead of softplus.
        least: Constant that is added to the diagonal of L.
        added: Constant that is added to the diagonal of M.
        unit: (n,) units of the rows of L [√(N·m s²)].
        potential: Whether the last output is V; otherwise the last n outputs are g(q).
        gravity_unit: (1,) unit of V or (n,) units of g(q) [N·m].
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
    """Fitted model in the form of arithmetic operations on plain arrays.

    Attributes:
        estimator: Name of the estimator.
        joint_names: Names of the n joints.
        effort_kind: Kind of the predicted effort: `current` or `torque`.
        geometry: Placements and axes of the joints.
        gravity: (3,) gravity in the base frame [m/s²].
        flange: (4, 4) pose of the flange in the frame of the last joint, because loads are defined
            in the flange frame.
        rigid: (n, 11) parameters of each link: a body in the joint frame, and the rotor inertia.
            All parameters `rigid` are zero if a Lagrangian network replaces the rigid body.
        gears: (n, 11) parameters for the torque that the gears transmit, on which friction depends.
        friction: Friction of the joints, with or without memory.
        scale: (n,) torque per unit of effort.
        correction: Residual networks, whose outputs are in effort units.
        lagrangian: Lagrangian network that replaces the rigid bodies of the arm; loads are still
            rigid bodies.
        coupling: (n, n) matrix T with joints = T · motors if a motor moves more than one joint;
            otherwise None. With a coupling, input samples and efforts refer to the motors. With a
            coupling, bodies and load contribute Tᵀ times the joint torques at T q, T q̇, T q̈,
            whereas rotors, friction, networks and scale refer to the motors.
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
        """Whether the output of the program depends on previous samples."""
        carried = getattr(self.friction, "length", None) is not None
        return carried or isinstance(self.friction, FrictionLaw) or self.correction is not None


BODY = 10
"""Number of parameters of a body in the order of `hil.dynamics.inertial`, without rotor inertia."""


def program_of(model: RobotEstimator) -> Program:
    """Return a fitted model as a program of arithmetic operations.

    Raises:
        NotExported: The estimator cannot be exported as a program.
        FitError: The model is not fitted.
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
            f"{model.estimator} predicts efforts at standstill, but a program needs efforts in "
            "motion",
            hint="use this model in hil.control.HandGuiding for hand guiding, export its "
            "parameters with --to json, or fit rigid-hysteresis to trajectories",
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
            "torque that the controller has to predict",
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
    """Error for an estimator that cannot be exported as a program."""


def bodies(full: FloatArray, n: int) -> FloatArray:
    """Return the parameters (n, 11) per link from the full parameters (11n,) in regressor order."""
    return np.column_stack([full[: BODY * n].reshape(n, BODY), full[BODY * n :]])


def terms_of(law: FrictionLaw) -> tuple[Mapping[str, FloatArray], ...]:
    """Return the coefficients of each friction group for each joint, by the name of the group."""
    found = []
    for names, flat in zip(law.chosen, law.coefficients, strict=True):
        counts = [law.count(name) for name in names]
        pieces = np.split(flat, np.cumsum(counts)[:-1])
        found.append(dict(zip(names, pieces, strict=True)))
    return tuple(found)


def flange_in_last_joint(robot: RobotModel) -> FloatArray:
    """Return the pose (4, 4) of the flange in the frame of the last joint, independent of q."""
    last = np.eye(4)
    for place in robot.joint_geometry().placement:
        last = last @ place
    flange = robot.flange_pose(np.zeros((1, robot.n)))[0]
    return np.asarray(np.linalg.solve(last, flange))


def shaped_of(model: RigidDiffnea) -> PlainFriction | ShapedFriction:
    """Return the friction of a fitted `rigid-diffnea` model."""
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
    # Without memory the power replaces the viscous term; with memory it is an additional term.
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
"""Copies of limits in `hil.networks.lagrangian_friction`, whose import would require torch."""


def lagrangian_terms(model: LagrangianEstimator) -> LagrangianTerms:
    """Return the Lagrangian network of a fitted `lagrangian` model."""
    from hil.networks import network_of

    settings = model.design_.network
    of_factor = settings.epsilon_of == "factor"
    dynamics = network_of(model.design_, model.torque_std_, model.weights_).dynamics
    # Rows of the placement for the diagonal of L have one non-zero entry: the unit.
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
    """Return the friction of a fitted `lagrangian` model."""
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
"""Length of the second state of a `ShapedFriction`, as a multiple of the first state's length."""

BLOCK = 4
"""Number of which padded channels and inputs are multiples; loops process this number at once."""


@dataclass(frozen=True, slots=True, eq=False)
class CellWeights:
    """Weights of residual networks: S input sets of F inputs, E cells of W channels, L layers.

    Each cell has K taps per layer and O outputs.

    A cell is the network of one branch and one fold. With layout `grouped` a cell belongs to one
    corrected joint, with layout `joint` to all joints. Every cell reads one set of inputs; the
    branches of a network share a set.

    F and W are multiples of `BLOCK`; padded entries have zero weights. In products over channels
    the output channels are the last axis; neighbouring outputs are therefore computed together.

    Attributes:
        means, rates, lowest, highest: (S, F) scales of the inputs: offset that is subtracted,
            factor, minimum and maximum.
        enter, enter_bias: (E, F·W) and (E, W) weights and biases from inputs to channels.
        taps, biases: (L·E, K·W·W) weights, with the oldest tap first, and (L·E, W) biases.
        leave, leave_bias: (E·O, W) and (E·O,) weights and biases from channels to outputs.
        share: (E·O,) weight of each output in the mean [effort unit].
        joints: (E·O,) number of the joint to which each output belongs.
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
    """Return the weights of all corrected joints, of which there must be at least one."""
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
    """Yield means, rates, lowest and highest values of a set of inputs, as in `NetworkInputs`."""
    scales, settings = network.inputs.scales, network.settings
    zero = np.zeros(network.n)
    if settings.layout == "joint":
        mean = np.column_stack([scales.q_mean, zero, zero]).ravel()
        scale = np.column_stack([scales.q, scales.qd, scales.qdd]).ravel()
    else:
        # Signs are not scaled.
        signs = len(settings.sign_widths)
        at = [group] if settings.base_input else []
        mean = np.r_[np.zeros(2 + signs), scales.base_mean[at]]
        base = scales.base[at]
        scale = np.r_[scales.qd[group], np.ones(signs), scales.qdd[group], base]
    for values in (mean, 1.0 / scale, scales.lowest[group], scales.highest[group]):
        yield filled(values, 0)


def filled(values: NDArray[np.float32] | FloatArray, *axes: int) -> FloatArray:
    """Return the values padded with zeros to a multiple of `BLOCK` along the axes."""
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
"""Mapping from a group of the friction library to the columns of the group as C expressions.

The expressions use quantities of one joint at the current sample: `v`, `speed` = |v|, `z3` (Dahl's
state with three times the shortest length), `tau` (torque through the gear) and `load` = |tau|,
`peak03` (Stribeck's exponential with 0.3 times the width), `law025` (sign(v)·|v|^0.25), `sin4`,
`cos4` (four periods per motor turn), `jsin1` (one period per joint turn).
"""

PEAKS = {"peak03": 0.3, "peak1": 1.0, "peak3": 3.0}
LAWS = {"law025": 0.25, "law05": 0.5, "law15": 1.5}
