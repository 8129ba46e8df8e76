"""Residual networks with weights drawn at random, and their C program built and run."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.export.c import network_piece
from hil.export.c_compiler import STRICT
from hil.networks.residual_data import InputScales, NetworkInputs, ResidualSettings, group_shape
from hil.networks.residual_network import CorrectedStream
from hil.networks.residual_selection import Correction
from hil.networks.residual_tcn import TcnWeights, TrainedTcn
from tests.support.c_programs import compiled

STEPS = """\
int main(int count, char **given)
{
    static hil_state state;
    hil_state *s = &state;
    const int again = count > 1 ? atoi(given[1]) : 0;
    double row[4 * HIL_N], out[HIL_N];
    int k;
    for (k = 0; fread(row, sizeof row, 1, stdin) == 1; k++) {
        if (k == 0 || k == again) {
            (void)s;
            RESET
        }
        hil_network(s, row, row + HIL_N, row + 2 * HIL_N, row + 3 * HIL_N, out);
        (void)fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""
"""Motions come in as rows of q, qd, qdd and base, efforts go out; reset before a row as well."""

TANH = """\
int main(void)
{
    float x;
    (void)hil_network;
    while (fread(&x, sizeof x, 1, stdin) == 1) {
        x = hil_network_tanh(x);
        (void)fwrite(&x, sizeof x, 1, stdout);
    }
    return 0;
}
"""

KINDS: dict[str, dict[str, Any]] = {
    "grouped": {"split": False},
    "grouped-relu-folds": {"activation": "relu", "networks": 3, "split": False},
    "grouped-branches-dropped": {"split": True, "kept": [True, False, True], "networks": 3},
    "grouped-without-base": {"base_input": False, "sign_widths": (0.2,), "activation": "relu"},
    "joint-branches": {"layout": "joint", "split": True},
    "joint-folds-dropped": {"layout": "joint", "split": False, "networks": 3, "kept": [0, 1, 1]},
    "joint-relu-branches": {"layout": "joint", "split": True, "activation": "relu", "channels": 5},
}


def correction(n=3, networks=1, kept=None, limit=1e6, seed=0, **settings) -> Correction:
    """Untrained networks that say something at once, and differ from each other."""
    random = np.random.default_rng(seed)
    small = {"channels": 6, "dilations": (1, 4), "kernel": 4}
    chosen = ResidualSettings(**small | settings)
    found = tuple(_network(chosen, n, random) for _ in range(networks))
    kept = np.ones(n, dtype=bool) if kept is None else np.array(kept, dtype=bool)
    return Correction(chosen, found, kept, np.full(n, limit))


def _network(settings, n, random) -> TrainedTcn:
    groups, inputs = group_shape(settings, n)
    shape = (groups, inputs)
    cells = groups * settings.branches
    width, kernel = settings.width, settings.kernel
    outputs = 1 if settings.layout == "grouped" else n

    def drawn(*sizes, deviation=1.0):
        return (deviation * random.normal(size=sizes)).astype(np.float32)

    layers = range(len(settings.dilations))
    weights = TcnWeights(
        enter=drawn(cells, width, inputs, deviation=inputs**-0.5),
        enter_bias=drawn(cells, width, deviation=0.3),
        taps=tuple(
            drawn(cells, width, width, kernel, deviation=(width * kernel) ** -0.5) for _ in layers
        ),
        biases=tuple(drawn(cells, width, deviation=0.3) for _ in layers),
        leave=drawn(cells, outputs, width),
        leave_bias=drawn(cells, outputs),
        dilations=settings.dilations,
        activation=settings.activation,
    )
    names = ("q_mean", "q", "qd", "qdd", "base_mean", "base", "heard_mean", "heard")
    means = {name: random.uniform(0.3, 1.5, n) for name in names}
    ends = {"lowest": -random.uniform(0.5, 2.0, shape), "highest": random.uniform(0.5, 2.0, shape)}
    inputs_of = NetworkInputs(settings, InputScales(**means, **ends))
    return TrainedTcn(
        inputs_of, weights, random.uniform(0.2, 2, (settings.branches, n)), 500.0, 1.0
    )


def motion(rows=60, n=3, seed=1) -> np.ndarray:
    """(rows, 4, n) q, qd, qdd and base: random walks that leave the range of the inputs."""
    random = np.random.default_rng(seed)
    return np.cumsum(0.3 * random.normal(size=(rows, 4, n)), axis=0)


def streamed(networks: Correction, rows: np.ndarray, again: int | None = None) -> np.ndarray:
    """(rows, n) that the Python stream adds; it begins afresh before row `again`."""
    pieces = [rows] if again is None else [rows[:again], rows[again:]]
    return np.concatenate([_stream(networks, piece) for piece in pieces])


def _stream(networks: Correction, rows: np.ndarray) -> np.ndarray:
    class Physics:
        def step(self, _q, _qd, _qdd):
            return base

    stream, added = CorrectedStream(Physics(), networks), []
    for *moved, base in rows:
        added.append(stream.step(*moved) - base)
    return np.array(added)


def built(
    networks: Correction, folder: Path, main: str = STEPS, flags: Sequence[str] = ("-O1",)
) -> Path:
    """The program's path; the test is skipped where nothing compiles it."""
    n = len(networks.kept)
    piece = network_piece(networks, n)
    source = (
        "#include <stdio.h>\n#include <stdlib.h>\n"
        f"#define HIL_N {n}\ntypedef struct {{\n{piece.state or 'int nothing;'}\n}} hil_state;\n"
        f"#define HIL_RESTRICT restrict\n{piece.constants}\n{piece.functions}\n"
        + main.replace("RESET", piece.reset)
    )
    (folder / "network.c").write_text(source)
    compiled("cc", [*STRICT, *flags, "network.c", "-o", "network"], folder)
    return folder / "network"


def ran(program: Path, rows: np.ndarray, *given: str) -> bytes:
    """What the program writes for these numbers."""
    done = subprocess.run([program, *given], input=rows.tobytes(), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[:2000]
    return done.stdout


def stepped(program: Path, rows: np.ndarray, again: int = 0) -> np.ndarray:
    """(rows, n) that the C program adds."""
    return np.frombuffer(ran(program, rows, str(again))).reshape(len(rows), -1)
