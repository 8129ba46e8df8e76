"""Reader of JSON documents that does not need hil: torques and friction from a document's numbers.

The module `json_reader` imports only numpy, so it can be copied to other projects. Every JSON
export reads its document with `json_reader` as a check.

`rigid_torque` evaluates the recursive Newton–Euler equations with the base parameters.
`friction_torque` sums the products of parameters and columns. The reader evaluates a column from
its formula, such as `z·exp(−|v|/vs)`. Friction states with memory start at the first sample.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Document = dict[str, Any]

BODY = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the link parameters about the origin of the joint frame; `Ia` is the rotor inertia."""


def rigid_torque(
    document: Document, q: Array, qd: Array, qdd: Array, group: str = "rigid",
    load: Array | None = None, links: Array | None = None,
) -> Array:  # fmt: skip
    """Return the torque (N, n) of gravity and inertia [N·m], by recursive Newton–Euler.

    Args:
        document: Exported document.
        q: (N, n) position.
        qd: (N, n) velocity.
        qdd: (N, n) acceleration.
        group: Name of the group of base parameters: `rigid`, `gear` or `gravity`.
        load: (10,) mass, centre of mass and inertia about the centre of mass (xx, yy, zz, xy, xz,
            yz) in the flange frame.
        links: (n, 11) link parameters that replace the base parameters, such as the result of
            `links_of`.
    """
    robot = document["robot"]
    bodies = base_bodies(document, group) if links is None else links.copy()
    rotors, bodies = bodies[:, 10], bodies[:, :10]
    if load is not None:
        bodies[-1] += load_at(np.array(robot["flange"]["placement"]), load)
    coupling = robot["joints_per_motor"]
    T = np.eye(len(bodies)) if coupling is None else np.array(coupling)
    out = _newton_euler(robot, bodies, q @ T.T, qd @ T.T, qdd @ T.T)
    return np.asarray(out @ T + rotors * qdd)


def _newton_euler(robot: Document, bodies: Array, q: Array, qd: Array, qdd: Array) -> Array:
    """Return the torques (N, n): motion is propagated outwards along the chain, forces inwards."""
    N, n = q.shape
    w, dw, a = np.zeros((N, 3)), np.zeros((N, 3)), np.tile(-np.array(robot["gravity_m_s2"]), (N, 1))
    places, forces, moments = [], [], []
    for j, (joint, body) in enumerate(zip(robot["joints"], bodies, strict=True)):
        pose, axis = np.array(joint["placement"]), np.array(joint["axis"])
        turns = joint["type"] == "revolute"
        R = pose[:3, :3] @ _turned(axis, q[:, j] if turns else np.zeros(N))
        p = pose[:3, 3] + np.outer(np.zeros(N) if turns else q[:, j], pose[:3, :3] @ axis)
        a = _back(R, a + np.cross(dw, p) + np.cross(w, np.cross(w, p)))
        w, dw = _back(R, w), _back(R, dw)
        rate, change = np.outer(qd[:, j], axis), np.outer(qdd[:, j], axis)
        if turns:
            dw = dw + np.cross(w, rate) + change
            w = w + rate
        else:
            a = a + 2.0 * np.cross(w, rate) + change
        m, h, inertia = body[0], body[1:4], _matrix(body[[4, 6, 9, 5, 7, 8]])
        forces.append(m * a + np.cross(dw, h) + np.cross(w, np.cross(w, h)))
        moments.append(np.cross(h, a) + dw @ inertia + np.cross(w, w @ inertia))
        places.append((R, p, axis, turns))
    out, f, t = np.zeros((N, n)), np.zeros((N, 3)), np.zeros((N, 3))
    for j in range(n)[::-1]:
        f, t = forces[j] + f, moments[j] + t
        R, p, axis, turns = places[j]
        out[:, j] = (t if turns else f) @ axis
        f = _forth(R, f)
        t = _forth(R, t) + np.cross(p, f)
    return out


def _turned(axis: Array, angle: Array) -> Array:
    """Return rotations (N, 3, 3) about a unit axis by angles (N,) (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, rest = np.sin(angle)[:, None, None], 1.0 - np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * K + rest * (K @ K))


def _back(R: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kji,kj->ki", R, x))


def _matrix(told: Array) -> Array:
    """Return a symmetric matrix (3, 3) from xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = told
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _forth(R: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kij,kj->ki", R, x))


def base_bodies(document: Document, group: str = "rigid") -> Array:
    """Return links (n, 11) with the passed base parameters; all other parameters are 0."""
    bodies = np.zeros((len(document["robot"]["joints"]), 11))
    for one in document["parameters"]:
        if one["group"] == group:
            kind, link = one["column"].split("_")
            bodies[int(link) - 1, 10 if kind == "Ia" else BODY.index(kind)] = one["value"]
    return bodies


def links_of(document: Document) -> Array:
    """Return the entries `links` as (n, 11), about the origins of the joint frames."""
    rows = []
    for link in document["links"]["values"]:
        body = _about_origin(link["mass_kg"], link["com_m"], _matrix(link["inertia_kgm2"]))
        rows.append([*body, link["rotor_inertia_kgm2"]])
    return np.array(rows)


def _about_origin(mass: float, com: Array, inertia: Array) -> Array:
    """Return ten body parameters, ordered as `BODY`, from the inertia about the centre of mass."""
    c = np.array(com)
    whole = inertia + mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.array([mass, *(mass * c), *whole[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def combined(document: Document, group: str = "rigid") -> Array:
    """Return (b, 2): each base parameter, and the combination of link parameters that it equals."""
    links, rows = links_of(document), []
    for one in document["parameters"]:
        if one["group"] == group:
            sums = 0.0
            for column, share in one["combination"].items():
                kind, link = column.split("_")
                sums += share * links[int(link) - 1, 10 if kind == "Ia" else BODY.index(kind)]
            rows.append((one["value"], sums))
    return np.array(rows)


def load_at(flange: Array, load: Array) -> Array:
    """Return a load (10,) in the frame of the last joint, from the flange pose (4, 4)."""
    R, p = flange[:3, :3], flange[:3, 3]
    return _about_origin(load[0], R @ load[1:4] + p, R @ _matrix(load[4:]) @ R.T)


def paper_gravity(document: Document, q: Array) -> Array:
    """Return the gravity torque (N, n) by eq. 15 of the static paper."""
    out, names = np.zeros_like(q), [joint["name"] for joint in document["robot"]["joints"]]
    for one in document["parameters"]:
        if one["group"] == "gravity":
            factors = [
                getattr(np, wave)(q[:, np.array(joints) - 1].sum(axis=1))
                for wave, joints in one["waves"]
            ]
            out[:, names.index(one["joint"])] += one["value"] * np.prod(factors, axis=0)
    return out


def of_joints(document: Document, word: str) -> Array:
    """Return the parameter `joint.word` (n,) of every joint; 0 for joints without it."""
    told = {one["name"]: one["value"] for one in document["parameters"]}
    names = [joint["name"] for joint in document["robot"]["joints"]]
    return np.array([told.get(f"{name}.{word}", 0.0) for name in names])


def torque_per_effort(document: Document) -> Array:
    """Return the drive gains (n,), which are 1 if they are unknown or efforts are torques."""
    told = document["effort"]["torque_per_effort"]["values"]
    return np.ones(len(document["robot"]["joints"])) if told is None else np.array(told)


NAME = r"[A-Za-zα-ω]+[0-9]*"
TOKEN = re.compile(rf"\s*([0-9]+(?:\.[0-9]+)?|{NAME}|[()|,+−·/^²])")

CALLS: dict[str, Callable[..., Any]] = {
    "exp": np.exp, "tanh": np.tanh, "sin": np.sin, "cos": np.cos, "sign": np.sign,
    "max": np.maximum,
}  # fmt: skip

CONSTANTS = {
    "w": "power_width_rad_s",
    "v0": "least_speed_rad_s",
    "vf": "ripple_fades_rad_s",
    "T0": "reference_celsius",
    "Tm": "mean_celsius",
    "N": "gear_ratio",
}
"""Mapping from symbol to key of `friction.constants`; not every document has every key."""

SUMMED = ("friction", "offset", "ripple", "drive")
"""Names of the groups of parameters that are multiplied by their columns."""


def friction_torque(
    document: Document, q: Array, qd: Array, tau: Array, known: Mapping[str, Array] | None = None
) -> Array:
    """Return the sum (N, n) of friction, offset, ripple and drive terms of each joint [N·m].

    Args:
        document: Exported document.
        q: (N, n) positions of consecutive samples; the order matters, because friction can have
            memory.
        qd: (N, n) velocity.
        tau: (N, n) torque through the gears, which is `rigid_torque` of the group `gear`, with the
            load.
        known: Mapping from symbol to values (N, n), for symbols that are not computed from the
            motion: `i`, or `d`, `z1`, … at standstill.
    """
    names = [joint["name"] for joint in document["robot"]["joints"]]
    limit = document["friction"]["constants"].get("load_limit_nm")
    tau = tau if limit is None else np.clip(tau, -np.array(limit), np.array(limit))
    motion = {"q": q, "v": qd, "τ": tau, **(known or {})}
    joints = [_symbols(document, j, motion) for j in range(len(names))]
    out = np.zeros_like(q)
    for one in document["parameters"]:
        if one["group"] in SUMMED:
            j = names.index(one["joint"])
            for state in symbols_of(one["column"]) - joints[j].keys():
                joints[j][state] = _dahl(q[:, j], qd[:, j], _length(state, joints[j]["x0"]))
            out[:, j] += one["value"] * column(one["column"], joints[j])
    return out


def _symbols(document: Document, j: int, motion: Mapping[str, Array]) -> dict[str, Any]:
    """Return the values of the symbols in columns of joint j, except Dahl's states."""
    constants, joint = document["friction"]["constants"], document["robot"]["joints"][j]["name"]
    found: dict[str, Any] = {name: values[:, j] for name, values in motion.items()}
    for symbol, key in CONSTANTS.items():
        if key in constants:
            found[symbol] = _of(constants[key], j)
    for one in document["parameters"]:
        if one["group"] == "shape" and one["joint"] == joint:
            found[one["column"]] = one["value"] or 0.0
    found.setdefault("T", _of(constants.get("usual_celsius"), j) or found.get("T0"))
    width = constants.get("sign_width_rad_s")
    found.setdefault("s", np.tanh(found["v"] / width) if width else np.sign(found["v"]))
    return found


def _of(value: Any, j: int) -> Any:
    return value[j] if isinstance(value, list) else value


def _dahl(q: Array, v: Array, length: float) -> Array:
    """Return Dahl's state (N,) of a joint; only displacements along the velocity change it."""
    out, z = np.zeros_like(q), 0.0
    for k in range(1, len(q)):
        way = q[k] - q[k - 1]
        if way * v[k] > 0.0:
            z = np.sign(way) + (z - np.sign(way)) * np.exp(-abs(way) / length)
        out[k] = z
    return out


def _length(state: str, shortest: float) -> float:
    if not re.fullmatch("z[0-9]*", state):
        raise KeyError(state)
    return shortest * float(state[1:] or 1)


def column(text: str, symbols: Mapping[str, Any]) -> Any:
    """Evaluate the formula of a column, such as `z·exp(−|v|/vs)`.

    Raises:
        ValueError: The formula is invalid.
        KeyError: A symbol of the formula is unknown.
    """
    tokens, at = [], 0
    while at < len(text.rstrip()):
        found = TOKEN.match(text, at)
        if found is None:
            raise ValueError(f"column {text!r}: cannot parse {text[at:]!r}")
        tokens.append(found[1])
        at = found.end()
    tokens.reverse()
    value = _sum(tokens, symbols)
    if tokens:
        raise ValueError(f"column {text!r}: unexpected {tokens[-1]!r}")
    return value


def _sum(tokens: list[str], symbols: Mapping[str, Any]) -> Any:
    """Evaluate a sum from a reversed list of tokens, whose last token is the first of the text."""
    minus = tokens[-1] == "−" and bool(tokens.pop())
    value = _product(tokens, symbols)
    value = -value if minus else value
    while tokens and tokens[-1] in "+−":
        sign = 1.0 if tokens.pop() == "+" else -1.0
        value = value + sign * _product(tokens, symbols)
    return value


def _product(tokens: list[str], symbols: Mapping[str, Any]) -> Any:
    value = _power(tokens, symbols)
    while tokens and tokens[-1] in "·/":
        times = tokens.pop() == "·"
        other = _power(tokens, symbols)
        value = value * other if times else value / other
    return value


def _power(tokens: list[str], symbols: Mapping[str, Any]) -> Any:
    value = _atom(tokens, symbols)
    if tokens and tokens[-1] in "²^":
        return value**2 if tokens.pop() == "²" else value ** _atom(tokens, symbols)
    return value


def _atom(tokens: list[str], symbols: Mapping[str, Any]) -> Any:
    first = tokens.pop()
    if first[0].isdigit():
        return float(first)
    if first not in CALLS and first not in "(|":
        return symbols[first]
    if first in CALLS:
        tokens.pop()  # opening bracket
    given = [_sum(tokens, symbols)]
    while tokens[-1] == ",":
        tokens.pop()
        given.append(_sum(tokens, symbols))
    tokens.pop()  # closing bracket
    if first == "|":
        return np.abs(given[0])
    return CALLS[first](*given) if first in CALLS else given[0]


def symbols_of(text: str) -> set[str]:
    """Return the symbols in the formula of a column."""
    return set(re.findall(NAME, text)) - CALLS.keys()


def rest_states(paths: Array, lengths: list[float]) -> dict[str, Array]:
    """Return `d`, `z1`, `z2`, … (N, n) for joints that came to a standstill.

    Args:
        paths: (N, K, n) smoothed paths of the joints into the poses, relative to the poses.
        lengths: Characteristic lengths of Dahl's states.
    """
    found = {"d": -np.sign(paths[:, 0])}
    steps = np.diff(np.concatenate([paths, np.zeros_like(paths[:, :1])], axis=1), axis=1)
    for k, length in enumerate(lengths):
        state = found["d"]
        for step in np.moveaxis(steps, 1, 0):
            state = np.sign(step) + (state - np.sign(step)) * np.exp(-np.abs(step) / length)
        found[f"z{k + 1}"] = state
    return found
