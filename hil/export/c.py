"""Export of a fitted model as a folder of C99: header, source, self-test and CMake file.

The C code of a program is in `hil/export/templates`, with one template for each part: the rigid
body, a Lagrangian network, one of the four kinds of friction, a residual network. The template of a
part sets up to four texts: its `constants`, its members of the `state` structure, its `functions`,
and its `reset` statements (see `Piece`). This module computes the numbers, sizes and expressions
for the templates. The template `model.c.j2` concatenates the parts.

All symbols in the templates begin with `hil_`; at the end, this beginning is replaced by the
requested prefix. Each number is written so that a compiler reads exactly the same bits (`literal`,
`array_literal`).

An exported program allocates no memory and has no global variables except constants. No input makes
an exported program divide by zero, compute the logarithm of 0 or exceed its arrays. An exported
program can therefore run in a PREEMPT_RT task, in a TwinCAT C++ module or on a microcontroller with
a double-precision library.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import FitError, FloatArray, SpecError
from hil.estimators import (
    MULTIPLES,
    ORDERS,
    REFERENCE_C,
    RIPPLE_FADES_RAD_S,
    SENSE_RAD_S,
    FrictionLaw,
    RobotEstimator,
)
from hil.estimators import PARTS as FRICTION_PARTS
from hil.export.agreement import LOAD, NETWORK, Golden, closeness, golden_of, precision
from hil.export.c_compiler import compile_program, require_compiler, run_self_test, size_note
from hil.export.exported import Exported, effort_unit, require_new, write_folder
from hil.export.program import (
    BLOCK,
    GROUPS,
    LAWS,
    LONG,
    PEAKS,
    Kind,
    LagrangianTerms,
    Layers,
    NetworkFriction,
    PlainFriction,
    Program,
    ShapedFriction,
    cell_weights,
    program_of,
    terms_of,
)
from hil.networks import Correction, ResidualSettings

if TYPE_CHECKING:
    from jinja2 import Environment

PARTS = ("gravity", "inertia", "load", "friction", "ripple", "drive", "residual")
"""Components of the effort in the order of `hil_parts`; the sum of the components is the effort."""

PREFIX = re.compile(r"[a-z][a-z0-9_]{0,30}\Z")

HEADERS = """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign
    stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time
    uchar wchar wctype features endian alloca malloc memory unistd values
"""
TARGETS = """
    all clean depend edit_cache help install list_install_components package package_source
    preinstall rebuild_cache test
"""
WORDS = """
    auto break case char const continue default do double else enum extern for goto if inline int
    long register return short signed sizeof static struct switch typedef union unsigned void
    volatile while restrict
"""
RESERVED = frozenset((HEADERS + TARGETS + WORDS).split())
"""Prefixes that would collide with a C header, a CMake target or a C keyword."""


def export_c(
    model: RobotEstimator, out: Path, *, prefix: str = "hil", unchecked: bool = False
) -> Exported:
    """Write a model as C files, after their self-test has passed in a temporary folder.

    Args:
        model: Fitted model.
        out: Folder that is created.
        prefix: Prefix of all file names and symbols.
        unchecked: Whether the program is written without compiling and testing it.

    Raises:
        FitError: The estimator cannot be exported, or the program does not agree with the model.
        PluginError: There is no C compiler.
        RecordingError: The folder already exists, or cannot be created.
        SpecError: The prefix is invalid.
    """
    require_new(out)
    if not unchecked:
        require_compiler()
    program = program_of(model)
    source = c_source(program, prefix, f"{program.estimator} of {Path(model.robot_.name).name}")
    written = {
        f"{prefix}.h": source.header,
        f"{prefix}.c": source.source,
        f"{prefix}_test.c": _self_test(prefix, program, golden_of(model)),
        "CMakeLists.txt": _render("CMakeLists.txt.j2", p=prefix),
    }
    checked, notes = ("", ()) if unchecked else _self_test_result(written, prefix)
    write_folder(written, out)
    memory = "with" if program.remembers else "without"
    parts = f"{program.estimator}, {memory} memory"
    unit = effort_unit(program.effort_kind)
    return Exported(out, tuple(written), program.joint_names, unit, parts, checked, notes)


def _self_test_result(written: Mapping[str, str], prefix: str) -> tuple[str, tuple[str, ...]]:
    """Return the result of the self-test and a note about the sizes of stack and state."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in written.items():
            (folder / file).write_text(text, "utf-8")
        program = compile_program(folder, (f"{prefix}.c", f"{prefix}_test.c"), "self_test")
        result_line, _, state = run_self_test(folder, program).partition("\n")
        return f"self-test: {result_line}", (size_note(folder, prefix, state),)


def _self_test(prefix: str, program: Program, golden: Golden) -> str:
    """Return the text of `PREFIX_test.c`, which reports the largest difference from the model.

    The self-test exits with 0 if the program agrees with the model.
    """
    expected = np.stack([golden.bare, golden.loaded])
    limits = closeness(program, golden)
    arrays = {
        "inputs": np.stack([golden.q, golden.qd, golden.qdd], axis=1),
        "wanted": expected if golden.residuals is None else expected - golden.residuals,
        "largest": limits.largest,
        "com": np.array(LOAD.com),
        "inertia": np.array(LOAD.inertia),
    }
    if golden.residuals is not None:
        arrays |= {"residuals": golden.residuals, "own": limits.residual / NETWORK}
    return _render(
        "self_test.c.j2",
        p=prefix,
        parts=PARTS,
        arrays=arrays,
        samples=len(golden.q),
        mass=LOAD.mass,
        most=precision(program),
        network=NETWORK,
    )


@dataclass(frozen=True, slots=True)
class CSource:
    """Texts of the header and of the source file.

    Attributes:
        prefix: Prefix of all symbols.
        header: Text of `PREFIX.h`.
        source: Text of `PREFIX.c`.
    """

    prefix: str
    header: str
    source: str


def c_source(program: Program, prefix: str = "hil", model_title: str = "") -> CSource:
    """Return the header and the source of a program.

    Args:
        program: Program to be written.
        prefix: Prefix of all symbols and name of the files.
        model_title: Name of the model, which is written at the top of both files.

    Raises:
        SpecError: The prefix is invalid.
    """
    if not PREFIX.match(prefix):
        raise SpecError(
            f"the prefix {prefix!r} cannot be the prefix of C function names",
            hint="use lower-case letters, digits and _, beginning with a letter, at most 31 "
            "characters",
        )
    if prefix in RESERVED:
        raise SpecError(
            f"the prefix {prefix!r} is reserved by C or CMake",
            hint="use a different prefix, such as arm",
        )
    correction = program.correction
    network = Piece() if correction is None else network_piece(correction, program.n)
    pieces = (_rigid_piece(program), _lagrangian_piece(program), _friction_piece(program), network)
    known: dict[str, Any] = {
        "title": comment_text(model_title or program.estimator),
        "warmth": _depends_on_temperature(program.friction),
    }
    header = _render(
        "model.h.j2",
        n=program.n,
        joints=comment_text(", ".join(program.joint_names)),
        units=_units(program),
        state="".join(piece.state for piece in pieces),
        parts=PARTS,
        **known,
    )
    source = _render(
        "model.c.j2",
        prefix=prefix,
        constants="".join(piece.constants for piece in pieces),
        functions="".join(piece.functions for piece in pieces),
        reset="".join(piece.reset for piece in pieces),
        scale=1.0 / program.scale,
        learned=program.lagrangian is not None,
        own_gears=_has_gear_inertia(program),
        corrected=network != Piece(),
        **known,
    )
    return CSource(prefix, _with_prefix(header, prefix), _with_prefix(source, prefix))


def _with_prefix(text: str, prefix: str) -> str:
    """Replace the prefix of all symbols, but not of the header name in `#include`."""
    text = re.sub(r'(?<!")\bhil_', f"{prefix}_", text)
    return re.sub(r"\bHIL_", f"{prefix.upper()}_", text)


def _units(program: Program) -> str:
    """Return a sentence about the units, with one unit per joint if some joints are prismatic."""
    torques = program.effort_kind != "current"
    turns = [bool(one) for one in program.geometry.turns]
    # The position of a motor has the unit of the joint that it moves.
    of_motors = program.coupling is not None
    start = "All arrays are per motor, on the output side of the gears. " if of_motors else ""
    if all(turns):
        return f"{start}Angles in rad, efforts in {'N*m' if torques else 'A'}."
    each = ", ".join("m" if not one else "rad" for one in turns)
    efforts = ", ".join("N*m" if one else "N" for one in turns) if torques else "A"
    return f"{start}Positions in {each}; efforts in {efforts}, in this order."


@dataclass(frozen=True, slots=True)
class Piece:
    """Texts that the template of one part of the program sets.

    Attributes:
        constants: Definitions of `static const` arrays.
        state: Members of the state structure, whose values are retained between samples.
        functions: Definitions of `static` functions, each after the functions that it calls.
        reset: Statements that reset the members of the state, to which `s` points.
    """

    constants: str = ""
    state: str = ""
    functions: str = ""
    reset: str = ""


def _piece(template: str, **values: Any) -> Piece:
    found = _environment().get_template(template).make_module(values)
    return Piece(**{name: getattr(found, name, "") for name in Piece.__slots__})


def _rigid_piece(program: Program) -> Piece:
    """Return the part of the program with `hil_move`, `hil_collect` and `hil_mount`."""
    return _piece(
        "rigid.c.j2",
        turn=program.geometry.placement[:, :3, :3],
        shift=program.geometry.placement[:, :3, 3],
        axis=program.geometry.axis,
        turns=[int(turns) for turns in program.geometry.turns],
        gravity=program.gravity,
        flange=program.flange,
        bodies=program.rigid,
        gears=program.gears if _has_gear_inertia(program) else None,
        coupling=program.coupling,
    )


def _has_gear_inertia(program: Program) -> bool:
    """Return whether gear torque and rigid-body torque have different parameters."""
    return not np.array_equal(program.gears, program.rigid)


def _friction_piece(program: Program) -> Piece:
    """Return the part with `hil_friction`, which computes friction [N·m] and updates its states.

    The C signature is `hil_friction(s, q, qd, tau, friction, ripple, drive)`.
    """
    friction = program.friction
    if isinstance(friction, PlainFriction):
        return _plain_piece(friction)
    if isinstance(friction, ShapedFriction):
        return _shaped_piece(friction)
    if isinstance(friction, NetworkFriction):
        return _piece(
            "friction_network.c.j2",
            layers=_dense(friction.layers),
            scale=friction.scale,
            dissipative=friction.dissipative,
            rest_speed=friction.rest_speed,
            **_c_type(friction.kind),
        )
    return _library_piece(friction)


def _plain_piece(friction: PlainFriction) -> Piece:
    columns = ("coulomb", "viscous", "offset", "exponent")
    rows = zip(*(getattr(friction, column) for column in columns), strict=True)
    return _piece(
        "friction_plain.c.j2",
        joints=[dict(zip(columns, row, strict=True)) for row in rows],
        sign_width=friction.sign_width,
        power_width=friction.power_width,
    )


def _shaped_piece(law: ShapedFriction) -> Piece:
    peaked = (law.static != law.coulomb) & (law.stribeck_exponent != 1.0)
    powers = bool(np.any(peaked) or np.any(law.power))
    return _piece("friction_shaped.c.j2", law=law, powers=powers, long=LONG)


MULTIPLE_AS_SUM = {2: (1, 1), 4: (2, 2), 8: (4, 4), 10: (8, 2), 12: (8, 4)}
"""Multiple k → (a, b) with k = a + b.

The addition theorem gives sin kφ and cos kφ of all multiples k from a single sine and cosine.
"""


def _library_piece(law: FrictionLaw) -> Piece:
    joints, count = [], 0
    for j, terms in enumerate(terms_of(law)):
        joint = _library_joint(law, j, terms, first=count)
        joints.append(joint)
        count += len(joint["states"])
    return _piece(
        "friction_library.c.j2",
        joints=joints,
        count=max(count, 1),
        ripple_fades=RIPPLE_FADES_RAD_S,
        sense=SENSE_RAD_S,
        warmth=_depends_on_temperature(law),
    )


def _library_joint(
    law: FrictionLaw, j: int, terms: Mapping[str, FloatArray], first: int
) -> dict[str, Any]:
    """Return the template values of joint j, whose first state has the number `first`."""
    terms_by_part: dict[str, list[str]] = {part: [] for part in ("friction", "ripple", "drive")}
    for name, weights in terms.items():
        part = terms_by_part[FRICTION_PARTS.get(name.split()[0], "friction")]
        columns = zip(GROUPS[name], weights, strict=True)
        part += [f"{literal(float(weight))} * {column}" for column, weight in columns if weight]
    used = set(re.findall(r"[a-z_]+\d*", " ".join(chain(*terms_by_part.values()))))
    shapes, usual = law.shapes, REFERENCE_C if law.celsius is None else float(law.celsius[j])
    multiples = [k for k in MULTIPLES if f"z{k:g}" in used]
    powers = {"law_p": float(shapes.power[j]), **LAWS}
    return {
        "used": used,
        "warmth": np.nan_to_num(usual - REFERENCE_C),
        "states": [
            (f"z{k:g}", first + place, -1.0 / (k * float(shapes.length[j])))
            for place, k in enumerate(multiples)
        ],
        "peaks": [
            (name, 1.0 / float(-width * shapes.stribeck[j]))
            for name, width in PEAKS.items()
            if name in used
        ],
        "powers": [(name, power) for name, power in powers.items() if name in used],
        "waves": _waves(float(np.nan_to_num(shapes.turns[j])), j, used),
        "sums": [(part, summed) for part, summed in terms_by_part.items() if summed],
    }


def _waves(
    turns: float, j: int, used: set[str]
) -> list[tuple[str, str, list[tuple[int, int, int]]]]:
    """Return the angle and its multiples k = a + b, for the motor (``) and for the joint (`j`)."""
    found = []
    for of, angle in (("", f"{literal(turns)} * q[{j}]"), ("j", f"q[{j}]")):
        if orders := {k for k in (*ORDERS, 1) if {f"{of}sin{k}", f"{of}cos{k}"} & used}:
            multiples = sorted(_needed(orders) - {1})
            found.append((of, angle, [(k, *MULTIPLE_AS_SUM[k]) for k in multiples]))
    return found


def _needed(orders: Iterable[int]) -> set[int]:
    """Return multiples of an angle, together with the multiples from which they are computed."""
    found = set(orders)
    return found.union(*(_needed(MULTIPLE_AS_SUM[k]) for k in found if k in MULTIPLE_AS_SUM))


def _depends_on_temperature(law: object) -> bool:
    """Return whether friction depends on the joint temperature."""
    return isinstance(law, FrictionLaw) and any("temperature" in terms for terms in terms_of(law))


ACTIVATIONS = {"softplus": "softplus", "relu": "relu", "tanh": "curve", "silu": "silu"}
"""Mapping from activation to the name of its C function; the name `tanh` is already taken in C."""

CALLEES: dict[str, tuple[str, ...]] = {
    "softplus": ("log1p", "within", "decay"),
    "softplus_slope": ("within", "decay"),
    "silu": ("softplus_slope",),
    "silu_slope": ("softplus_slope",),
    "curve": ("within", "decay"),
    "curve_slope": ("curve",),
}
"""Mapping from a C function to the functions that it calls or whose result it needs.

Only the needed functions are written, because unused static functions cause compiler warnings.
"""


def _lagrangian_piece(program: Program) -> Piece:
    """Return the part of the program that evaluates a Lagrangian network.

    The C function `hil_lagrangian` adds M(q)·q̈ + C(q, q̇)·q̇ + g(q) [N·m] to `torque`. The part
    with the Lagrangian network also contains the activation functions of a friction network.
    """
    terms = program.lagrangian
    if terms is None:
        return Piece()
    n, activation = len(terms.unit), ACTIVATIONS[terms.activation]
    return _piece(
        "lagrangian.c.j2",
        layers=_dense(terms.trunk),
        called=_needed_functions(program, terms),
        activation=activation,
        features=2 * n if terms.sincos else n,
        entries=n * (n + 1) // 2,
        unit=terms.unit,
        gravity_unit=terms.gravity_unit,
        sincos=terms.sincos,
        rectified=terms.rectified,
        potential=terms.potential,
        least=terms.least,
        added=terms.added,
        **_c_type(terms.kind),
    )


def _needed_functions(program: Program, terms: LagrangianTerms) -> set[str]:
    """Return the activation functions of the program and all functions that they call."""
    diagonal = "relu" if terms.rectified else "softplus"
    left = [
        name + end for name in (ACTIVATIONS[terms.activation], diagonal) for end in ("", "_slope")
    ]
    if isinstance(program.friction, NetworkFriction) and len(program.friction.layers.weights) > 1:
        left.append("curve")
    called: set[str] = set()
    while left:
        name = left.pop()
        called.add(name)
        left += CALLEES.get(name, ())
    return called


def _c_type(kind: Kind) -> dict[str, str]:
    """Return the C type of a network's numbers, and the suffix of its literals and functions."""
    return {"real": kind, "f": "f" if kind == "float" else ""}


DENSE_BLOCK = 8
"""Number of which the padded widths of fully connected layers are multiples."""

LANES, MOST_CHUNK = 16, 128
"""Number of partial sums in the backward pass, and maximum number of outputs per expression."""


@dataclass(frozen=True, slots=True, eq=False)
class DenseLayer:
    """Fully connected layer, whose widths are padded with zeros.

    Attributes:
        weight: (inputs · outputs,) weights; the weights from one input to all outputs are
            contiguous.
        bias: (outputs,) biases.
        inputs, outputs: Number of inputs and outputs after padding.
        slopes_before: Total number of outputs of all previous layers.
    """

    weight: FloatArray
    bias: FloatArray
    inputs: int
    outputs: int
    slopes_before: int

    @property
    def loops(self) -> tuple[int, int, int, int]:
        """Inputs, outputs, and the partial sums and outputs per expression of the backward pass."""
        lanes = LANES if self.outputs % LANES == 0 else DENSE_BLOCK
        chunks = range(lanes, MOST_CHUNK + 1, lanes)
        return self.inputs, self.outputs, lanes, max(c for c in chunks if self.outputs % c == 0)


def _dense(layers: Layers) -> list[DenseLayer]:
    found, before = [], 0
    for weight, bias in zip(layers.weights, layers.biases, strict=True):
        weight, bias = (
            np.pad(values, [(0, -size % DENSE_BLOCK) for size in values.shape])
            for values in (weight, bias)
        )
        outputs, inputs = weight.shape
        found.append(DenseLayer(weight.T.ravel(), bias, inputs, outputs, before))
        before += outputs
    return found


def _row_sum(row: int, lanes: int, chunk: int, first: str = "") -> str:
    """Return an expression for the products of a row, `lanes` apart, added in pairs."""
    terms = [f"w{row}[{first}{c} + l] * y[{first}{c} + l]" for c in range(0, chunk, lanes)]
    while len(terms) > 1:
        terms = [f"({' + '.join(terms[k : k + 2])})" for k in range(0, len(terms), 2)]
    return terms[0]


def network_piece(correction: Correction, n: int) -> Piece:
    """Return the part of the program that computes the correction of the physics.

    The C function `hil_network` processes one sample. The inputs of `hil_network` are q [rad], qd
    [rad/s], qdd [rad/s²] and the effort `base` of the physics, with `HIL_N` numbers each. The
    output of `hil_network` has `HIL_N` numbers, which are 0 for joints that use no network. The
    result of `hil_network` equals that of `CorrectedStream`, at standstill too.

    Args:
        correction: Networks whose inputs are the motion only (`inputs: motion`).
        n: Number of joints.

    Raises:
        FitError: The networks have torque inputs.
        ValueError: The networks have different numbers of joints, or weights that are not finite.
    """
    settings = correction.settings
    if settings.inputs != "motion":
        raise FitError(
            f"the residual network has inputs: {settings.inputs}, but a C program has only the "
            "motion as input",
            hint="fit residual with inputs: motion",
        )
    if len(correction.kept) != n:
        raise ValueError(f"networks of {len(correction.kept)} joints, but the robot has {n}")
    if not np.any(correction.kept):
        return _piece("residual.c.j2", cells=None)
    cells = cell_weights(correction)
    reach = [(settings.kernel - 1) * dilation + 1 for dilation in settings.dilations]
    inputs, unused = _network_inputs(settings, np.flatnonzero(correction.kept).tolist(), n)
    return _piece(
        "residual.c.j2",
        cells=cells,
        settings=settings,
        sizes={
            "SETS": len(cells.means),
            "GROUPS": len(cells.means) // len(correction.networks),
            "INPUTS": cells.means.shape[1],
            "BRANCHES": settings.branches,
            "CELLS": len(cells.enter),
            "WIDTH": cells.biases.shape[1],
            "LAYERS": len(reach),
            "KERNEL": settings.kernel,
            "OUTPUTS": len(cells.leave) // len(cells.enter),
        },
        rows=sum(reach),
        first=[0, *np.cumsum(reach)[:-1].tolist()],
        limit=np.where(correction.kept, correction.limit, 0.0),
        inputs=inputs,
        unused=unused,
    )


def _network_inputs(
    settings: ResidualSettings, kept: list[int], n: int
) -> tuple[list[str], list[str]]:
    """Return the unscaled inputs of all groups in sequence, and the names of unused arguments."""
    if settings.layout == "grouped":
        # Velocity, signs, acceleration and, if selected, physics effort of each corrected joint.
        groups = [
            [
                f"qd[{joint}]",
                *(_sign(joint, width) for width in settings.sign_widths),
                f"qdd[{joint}]",
                *([f"base[{joint}]"] if settings.base_input else []),
            ]
            for joint in kept
        ]
        unused = ["q"] if settings.base_input else ["q", "base"]
    else:
        groups = [[f"{name}[{joint}]" for joint in range(n) for name in ("q", "qd", "qdd")]]
        unused = ["base"]
    return [one for group in groups for one in [*group, *["0.0"] * (-len(group) % BLOCK)]], unused


def _sign(joint: int, width: float) -> str:
    # The clipping keeps the cast to float from overflowing; tanh(8) = 1 − 2e−7.
    scaled = f"hil_network_clip(qd[{joint}] / {literal(width)}, -8.0, 8.0)"
    return f"(double)hil_network_tanh((float){scaled})"


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = files("hil.export").joinpath("templates")
    environment = Environment(  # noqa: S701  # C, not HTML; foreign text goes through `comment_text`
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text("utf-8")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["literal"] = literal
    environment.globals |= {"array_literal": array_literal, "row_sum": _row_sum}
    return environment


def _render(template: str, **values: Any) -> str:
    return _environment().get_template(template).render(values)


def comment_text(text: str) -> str:
    """Return external text with unusual characters replaced by `_`, for use in a C comment.

    The replaced characters include those that could end a comment or start a line. Names of joints,
    robots and estimators come from external files.
    """
    return re.sub(r"[^A-Za-z0-9_ .,+-]", "_", text)


def literal(value: float, kind: Kind = "double") -> str:
    """Return a C literal from which a compiler reads the same bits.

    Raises:
        ValueError: The value is not finite in the C type.
    """
    with np.errstate(over="ignore"):
        stored = np.float32(value) if kind == "float" else np.float64(value)
    if not np.isfinite(stored):
        raise ValueError(f"{value} cannot be a constant of the program")
    text = str(stored) if kind == "float" else repr(float(stored))
    if "." not in text and "e" not in text:
        text += ".0"
    return text + ("f" if kind == "float" else "")


def array_literal(name: str, values: FloatArray, kind: Kind = "double") -> str:
    """Return the definition of a `static const` array of any shape with its initialiser.

    Raises:
        ValueError: A value is not finite.
    """
    values = np.asarray(values)
    sizes = "".join(f"[{size}]" for size in values.shape)
    return f"static const {kind} {name}{sizes} = {_braced(values, kind)};"


def _braced(values: FloatArray, kind: Kind) -> str:
    if values.ndim == 0:
        return literal(float(values), kind)
    parts = [_braced(one, kind) for one in values]
    if values.ndim > 1:
        return "{\n" + ",\n".join(parts) + "}"
    lines = [", ".join(parts[first : first + 6]) for first in range(0, len(parts), 6)]
    return "{" + ",\n ".join(lines) + "}"
