"""Activations as C, with no function that nobody calls: compilers warn of those."""

from __future__ import annotations

from collections.abc import Iterable

from hil.export import c_activations_text as text
from hil.export.c_text import Kind

NAMES = {"softplus": "softplus", "relu": "relu", "tanh": "curve", "silu": "silu"}
"""Activation → what its function is called in C, where `tanh` is taken."""

TIMES = {"curve": "TWO"}
"""What e to the minus |x| times this is asked for, if not times 1."""

NEEDS: dict[str, tuple[str, ...]] = {
    "within": (),
    "decay": (),
    "log1p": (),
    "softplus": ("log1p", "within", "decay"),
    "softplus_slope": ("within", "decay"),
    "silu": ("softplus_slope",),
    "silu_slope": ("softplus_slope",),
    "curve": ("within", "decay"),
    "curve_slope": ("curve",),
    "relu": (),
    "relu_slope": (),
}
"""Function → those it calls, or whose result it takes; in the order in which they are written."""


def activation_functions(wanted: Iterable[str], kind: Kind) -> str:
    """The wanted functions of `NEEDS` and all that they call, as C."""
    called: set[str] = set()
    left = list(wanted)
    while left:
        name = left.pop()
        called.add(name)
        left += NEEDS[name]
    return typed("".join(_text(name, kind) for name in NEEDS if name in called), kind)


def faded(name: str, what: str) -> str:
    """The second argument of an activation at `what`: e to the minus its size."""
    if name == "relu":
        return "ZERO"
    return f"hil_decay(hil_within({TIMES.get(name, 'ONE')} * FABS({what})))"


def typed(code: str, kind: Kind) -> str:
    """A template with its precision filled in."""
    suffix = "f" if kind == "float" else ""
    words = {"ZERO": "0.0", "HALF": "0.5", "ONE": "1.0", "TWO": "2.0", "EIGHTY": "80.0"}
    for word, value in (*words.items(), ("FABS", "fabs"), ("COPYSIGN", "copysign")):
        code = code.replace(word, value + suffix)
    return code.replace("REAL", kind)


def _text(name: str, kind: Kind) -> str:
    own = f"{name.upper()}_{kind.upper()}"
    found: str = getattr(text, own if hasattr(text, own) else name.upper())
    return found
