"""Activations as C, with no function that nobody calls: compilers warn of those."""

from __future__ import annotations

from collections.abc import Iterable

from hil.deploy.export import c_dense_text as text
from hil.deploy.export.c_text import Kind

NAMES = {"softplus": "softplus", "relu": "relu", "tanh": "curve", "silu": "silu"}
"""Activation → what its function is called in C, where `tanh` is taken."""

NEEDS: dict[str, tuple[str, ...]] = {
    "decay": (),
    "log1p": (),
    "size": (),
    "softplus": ("decay", "log1p", "size"),
    "softplus_slope": ("decay", "size"),
    "silu": ("softplus_slope",),
    "silu_slope": ("softplus_slope",),
    "curve": ("decay", "size"),
    "curve_slope": ("curve",),
    "relu": (),
    "relu_slope": (),
}
"""Function → those it calls; in the order in which they are written."""


def activation_functions(wanted: Iterable[str], kind: Kind) -> str:
    """The wanted functions of `NEEDS` and all that they call, as C."""
    called: set[str] = set()
    left = list(wanted)
    while left:
        name = left.pop()
        called.add(name)
        left += NEEDS[name]
    return typed("".join(_text(name, kind) for name in NEEDS if name in called), kind)


def typed(code: str, kind: Kind) -> str:
    """A template with its precision filled in."""
    suffix = "f" if kind == "float" else ""
    for word, value in (("ZERO", "0.0"), ("ONE", "1.0"), ("TWO", "2.0")):
        code = code.replace(word, value + suffix)
    return code.replace("REAL", kind)


def _text(name: str, kind: Kind) -> str:
    own = f"{name.upper()}_{kind.upper()}"
    found: str = getattr(text, own if hasattr(text, own) else name.upper())
    return found
