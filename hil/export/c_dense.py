"""Fully connected layers as C: constants, and one function per size of layer and way through it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hil.core import FloatArray
from hil.export import c_dense_text as text
from hil.export.c_activations import NAMES, TIMES, typed
from hil.export.c_text import Kind, array
from hil.export.lagrangian_terms import Layers

BLOCK = 8
"""Widths are filled up to a multiple with zeros."""

LANES, MOST_CHUNK = 16, 128
"""Partial sums on the way back, and outputs that are summed in one expression."""

Size = tuple[int, int]
"""Inputs and outputs of a layer, filled up."""


def filled(values: FloatArray) -> FloatArray:
    """Zeros behind the values along all axes, up to multiples of `BLOCK`."""
    return np.pad(values, [(0, -size % BLOCK) for size in values.shape])


def sizes_of(layers: Layers) -> list[Size]:
    """Of all layers as C has them."""
    return [(weight.shape[1], weight.shape[0]) for weight in map(filled, layers.weights)]


def layer_constants(name: str, layers: Layers, kind: Kind) -> str:
    """`hil_NAME_weight0`, `hil_NAME_bias0` and so on; the outputs of an input lie together."""
    lines = []
    for k, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        lines.append(array(f"hil_{name}_weight{k}", filled(weight).T.ravel(), kind))
        lines.append(array(f"hil_{name}_bias{k}", filled(bias), kind))
    return "".join(lines)


def sized(template: str, sizes: Iterable[Size], kind: Kind, activation: str = "") -> str:
    """A template of `c_dense_text` for every size there is, once."""
    name = NAMES.get(activation, "")
    fade = text.NO_FADE if name == "relu" else text.FADE
    named = template.replace("FADE", fade).replace("ACTIVATION", name)
    named = named.replace("TIMES", TIMES.get(name, "ONE"))
    return typed("".join(_sized(named, size) for size in dict.fromkeys(sizes)), kind)


def _sized(template: str, size: Size) -> str:
    inputs, outputs = size
    lanes = LANES if outputs % LANES == 0 else BLOCK
    chunk = max(c for c in range(lanes, MOST_CHUNK + 1, lanes) if outputs % c == 0)
    products = text.AT_ONCE if chunk == outputs else text.IN_CHUNKS
    sums = "".join(f"{_products(r, lanes, chunk, outputs)}\n" for r in range(4))
    found = template.replace("PRODUCTS", products).replace("SUMS", sums)
    found = found.replace("FOLDS", _folds(lanes))
    for word, number in (("LANES", lanes), ("CHUNK", chunk), ("IN", inputs), ("OUT", outputs)):
        found = found.replace(word, str(number))
    return found


def _products(row: int, lanes: int, chunk: int, outputs: int) -> str:
    """Products of a row, added in pairs."""
    first, indent, adds = ("", 12, "=") if chunk == outputs else ("c + ", 16, "+=")
    terms = [f"w{row}[{first}{c} + l] * y[{first}{c} + l]" for c in range(0, chunk, lanes)]
    while len(terms) > 1:
        pairs = [" + ".join(terms[k : k + 2]) for k in range(0, len(terms), 2)]
        terms = [f"({pair})" for pair in pairs]
    return f"{' ' * indent}t{row}[l] {adds} {terms[0]};"


def _folds(lanes: int) -> str:
    """Halves put upon each other until four sums are left."""
    lines = ""
    while lanes > 4:
        lanes //= 2
        adds = " ".join(f"t{r}[l] += t{r}[l + {lanes}];" for r in range(4))
        lines += f"        for (l = 0; l < {lanes}; l++) {{ {adds} }}\n"
    return lines
