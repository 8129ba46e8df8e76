"""Columns of a JSON document computed as they are written there, and friction as their sum.

Nothing but numpy, and nothing of hil: may be copied to where documents are used, as `json_read`.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Document = dict[str, Any]

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
"""Symbol → key of the document's `friction.constants`, where it has it."""

SUMMED = ("friction", "offset", "ripple", "drive")
"""Groups of parameters that are multiplied with their columns."""


def friction_torque(
    document: Document, q: Array, qd: Array, tau: Array, known: Mapping[str, Array] | None = None
) -> Array:
    """(N, n) all that joints have for themselves: friction, offset, ripple and drive [N·m].

    Args:
        document: As exported.
        q: (N, n) sample after sample: friction with memory begins with the first.
        qd: (N, n).
        tau: (N, n) torque through the gears: `rigid_torque` of the group `gear`, with the load.
        known: Symbols (N, n) that are not computed from these: `i`, or `d`, `z1`, … at rest.
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


def column(text: str, symbols: Mapping[str, Any]) -> Any:
    """A column as it is written, such as `z·exp(−|v|/vs)`.

    Raises:
        ValueError: It cannot be read.
        KeyError: A symbol is not known.
    """
    tokens, at = [], 0
    while at < len(text.rstrip()):
        found = TOKEN.match(text, at)
        if found is None:
            raise ValueError(f"column {text!r}: what is {text[at:]!r}?")
        tokens.append(found[1])
        at = found.end()
    tokens.reverse()
    value = _sum(tokens, symbols)
    if tokens:
        raise ValueError(f"column {text!r}: {tokens[-1]!r} is too much")
    return value


def symbols_of(text: str) -> set[str]:
    """Symbols that a column names."""
    return set(re.findall(NAME, text)) - CALLS.keys()


def rest_states(paths: Array, lengths: list[float]) -> dict[str, Array]:
    """`d`, `z1`, `z2`, … (N, n) of joints that came to rest by smoothed paths (N, K, n) to 0."""
    found = {"d": -np.sign(paths[:, 0])}
    steps = np.diff(np.concatenate([paths, np.zeros_like(paths[:, :1])], axis=1), axis=1)
    for k, length in enumerate(lengths):
        state = found["d"]
        for step in np.moveaxis(steps, 1, 0):
            state = np.sign(step) + (state - np.sign(step)) * np.exp(-np.abs(step) / length)
        found[f"z{k + 1}"] = state
    return found


def _symbols(document: Document, j: int, motion: Mapping[str, Array]) -> dict[str, Any]:
    """What columns of joint j may name, but for Dahl's states."""
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


def _length(state: str, shortest: float) -> float:
    if not re.fullmatch("z[0-9]*", state):
        raise KeyError(state)
    return shortest * float(state[1:] or 1)


def _dahl(q: Array, v: Array, length: float) -> Array:
    """(N,) state of one joint; only way that goes with the velocity counts."""
    out, z = np.zeros_like(q), 0.0
    for k in range(1, len(q)):
        way = q[k] - q[k - 1]
        if way * v[k] > 0.0:
            z = np.sign(way) + (z - np.sign(way)) * np.exp(-abs(way) / length)
        out[k] = z
    return out


def _sum(tokens: list[str], symbols: Mapping[str, Any]) -> Any:
    """Tokens are taken from the end, where the text begins."""
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
        tokens.pop()  # its bracket
    given = [_sum(tokens, symbols)]
    while tokens[-1] == ",":
        tokens.pop()
        given.append(_sum(tokens, symbols))
    tokens.pop()  # what closes
    if first == "|":
        return np.abs(given[0])
    return CALLS[first](*given) if first in CALLS else given[0]
