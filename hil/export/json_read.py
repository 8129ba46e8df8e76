"""What can be computed from a JSON document with nothing but numpy: a reader without hil.

The check of every export reads its document with this. Nothing here imports hil, so that it can be
copied to where documents are used.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Document = dict[str, Any]

BODY = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Parameters of a link about the origin of its joint's frame; `Ia` is its rotor's inertia."""


def rigid_torque(
    document: Document, q: Array, qd: Array, qdd: Array, group: str = "rigid",
    load: Array | None = None, links: Array | None = None,
) -> Array:  # fmt: skip
    """(N, n) torque of gravity and inertia [N·m], by recursive Newton–Euler.

    Args:
        document: As exported.
        q: (N, n), with qd and qdd the motion.
        qd: (N, n).
        qdd: (N, n).
        group: Which base parameters: `rigid`, `gear` or `gravity`.
        load: (10,) mass, centre and inertia about it (xx, yy, zz, xy, xz, yz) in the flange's
            frame.
        links: (n, 11) in place of base parameters, such as `links_of`.
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


def base_bodies(document: Document, group: str = "rigid") -> Array:
    """(n, 11) the links with these base parameters whose other parameters are 0."""
    bodies = np.zeros((len(document["robot"]["joints"]), 11))
    for one in document["parameters"]:
        if one["group"] == group:
            kind, link = one["column"].split("_")
            bodies[int(link) - 1, 10 if kind == "Ia" else BODY.index(kind)] = one["value"]
    return bodies


def links_of(document: Document) -> Array:
    """(n, 11) of `links`, about the origins of the joints' frames."""
    rows = []
    for link in document["links"]["values"]:
        body = _about_origin(link["mass_kg"], link["com_m"], _matrix(link["inertia_kgm2"]))
        rows.append([*body, link["rotor_inertia_kgm2"]])
    return np.array(rows)


def combined(document: Document, group: str = "rigid") -> Array:
    """(b, 2) base parameters, and the sums of the links' parameters that they should be."""
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
    """(10,) a load in the frame of the last joint, the flange's pose (4, 4) being known."""
    R, p = flange[:3, :3], flange[:3, 3]
    return _about_origin(load[0], R @ load[1:4] + p, R @ _matrix(load[4:]) @ R.T)


def paper_gravity(document: Document, q: Array) -> Array:
    """(N, n) gravity by eq. 15 of the static paper, from products of waves of sums of angles."""
    out, names = np.zeros_like(q), [joint["name"] for joint in document["robot"]["joints"]]
    for one in document["parameters"]:
        if one["group"] == "gravity":
            factors = [
                getattr(np, wave)(q[:, np.array(joints) - 1].sum(axis=1))
                for wave, joints in one["waves"]
            ]
            out[:, names.index(one["joint"])] += one["value"] * np.prod(factors, axis=0)
    return out


def of_joints(document: Document, word: str, otherwise: float = 0.0) -> Array:
    """(n,) the parameter `joint.word` of every joint."""
    told = {one["name"]: one["value"] for one in document["parameters"]}
    names = [joint["name"] for joint in document["robot"]["joints"]]
    return np.array([told.get(f"{name}.{word}", otherwise) for name in names])


def torque_per_effort(document: Document) -> Array:
    """(n,) drive gains; 1 where nobody knew them, or efforts are torques."""
    told = document["effort"]["torque_per_effort"]["values"]
    return np.ones(len(document["robot"]["joints"])) if told is None else np.array(told)


def _newton_euler(robot: Document, bodies: Array, q: Array, qd: Array, qdd: Array) -> Array:
    """(N, n) torques of a motion (N, n): out along the chain with motion, back with forces."""
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


def _forth(R: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kij,kj->ki", R, x))


def _back(R: Array, x: Array) -> Array:
    return np.asarray(np.einsum("kji,kj->ki", R, x))


def _about_origin(mass: float, com: Array, inertia: Array) -> Array:
    """(10,) in the order of `BODY` from an inertia about the centre of mass."""
    c = np.array(com)
    whole = inertia + mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.array([mass, *(mass * c), *whole[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def _matrix(told: Array) -> Array:
    """(3, 3) from xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = told
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _turned(axis: Array, angle: Array) -> Array:
    """(N, 3, 3) rotations about an axis of length 1 by angles (N,), Rodrigues."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, rest = np.sin(angle)[:, None, None], 1.0 - np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * K + rest * (K @ K))
