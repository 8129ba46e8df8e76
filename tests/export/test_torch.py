"""PyTorch modules of every kind of model, before they are traced, and what is in the archive."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.arms.payload import Payload  # noqa: E402
from hil.estimators import friction_library  # noqa: E402
from hil.estimators.base import RobotEstimator  # noqa: E402
from hil.export.agreement import LOAD, golden_of, largest_difference, load_row  # noqa: E402
from hil.export.torch_export import pickles  # noqa: E402
from hil.export.torch_modules import StreamingTcn, TorchModel, module_of  # noqa: E402
from tests.support.export_models import ARMS, KINDS, fitted  # noqa: E402
from tests.support.lagrangian_models import CASES  # noqa: E402
from tests.support.random_networks import KINDS as NETWORKS  # noqa: E402
from tests.support.random_networks import correction, motion, streamed  # noqa: E402
from tests.support.synthetic_memory import remembering, stopping  # noqa: E402

MEMORY, WARM = "rigid-hysteresis every group", "rigid-hysteresis warm"
SLIDES, *_ = ARMS
MODULES = [
    *(kind for kind in KINDS if kind.startswith("rigid")), MEMORY, "residual folds", *ARMS,
    *(f"lagrangian: {case}" for case in CASES),
]  # fmt: skip
OFF = {
    "rigid-diffnea memory": 1e-7,  # the speed within its peak is 1e-9 rad/s off
    "residual folds": 1e-6,
} | {f"lagrangian: {case}": 2e-6 for case in CASES}


def stepping(module):
    def step(inputs):
        with torch.no_grad():
            return [found.numpy() for found in module(*map(torch.tensor, inputs))]

    return step


def off_by(model: RobotEstimator) -> tuple[TorchModel, float]:
    """The module, and its largest difference from the model."""
    traced = module_of(model)
    golden = golden_of(model, samples=80)
    return traced, largest_difference(stepping(traced.module), golden, traced.state_size)


@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=() if k == SLIDES else pytest.mark.thorough) for k in MODULES],
)
def test_a_module_has_the_efforts_of_the_model(kind) -> None:
    traced, off = off_by(fitted(kind))
    assert off < OFF.get(kind, 1e-12)
    rate = pytest.approx(100.0) if kind == "residual folds" else None
    assert traced.rate_hz == rate


@pytest.mark.parametrize("kind", NETWORKS.values(), ids=NETWORKS)
def test_a_network_says_what_its_stream_says(kind) -> None:
    networks, rows = correction(**kind), motion()
    module = StreamingTcn(networks)
    carried = {name: torch.zeros(1, size, dtype=torch.float64) for name, size in module.parts}
    found, expected = [], streamed(networks, rows)
    for k, row in enumerate(rows):
        with torch.no_grad():
            inputs = (torch.tensor(one[None]) for one in row)
            added, carried = module(*inputs, torch.full((1, 1), k > 0), carried)
        found.append(added[0].numpy())
    assert np.array(found) == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.thorough
def test_it_can_be_differentiated_for_control() -> None:
    traced = module_of(fitted("rigid-hysteresis"))
    random = torch.Generator().manual_seed(0)
    rows = [torch.rand(1, 6, generator=random, dtype=torch.float64) + 0.1 for _ in range(3)]
    load = torch.tensor(load_row(LOAD))
    start = torch.zeros(1, traced.state_size, dtype=torch.float64)
    _, state = traced.module(*rows, load, start)
    rows[0] = rows[0] + 2e-4  # a way on which memory comes round

    def effort(*motion):
        return traced.module(*motion, load, state)[0]

    inputs = tuple(row.requires_grad_() for row in rows)
    assert torch.autograd.gradcheck(effort, inputs, eps=1e-7, atol=1e-4)


def test_units_are_told_joint_by_joint() -> None:
    units = module_of(fitted(SLIDES)).units
    slides = ["rad", "m", "rad"]
    assert (units["q"], units["effort"]) == (slides, ["N*m", "N", "N*m"])
    assert units["qd"] == [f"{one}/s" for one in slides]
    assert units["qdd"] == [f"{one}/s2" for one in slides]
    assert len(units["load"]) == 10


@pytest.mark.thorough
def test_joints_follow_their_temperature_as_predict_says(monkeypatch) -> None:
    model = fitted(WARM)
    traced = module_of(model)
    assert ("warmer_k", 6) in traced.state
    t, q, qd, qdd = stopping(5, 300)
    # Where `predict` sums velocities up, a program takes differences of positions.
    q = q[:1] + np.vstack([np.zeros(6), np.cumsum(0.5 * (qd[1:] + qd[:-1]), axis=0) * t[1]])
    celsius = np.linspace(20.0, 45.0, 300)[:, None] + np.arange(6.0)
    asked = remembering(5, celsius=(20.0, 45.0), samples=300)
    columns = {**asked.columns, "temperature": celsius, "q_f": q, "qd_f": qd, "qdd_f": qdd}
    asked = replace(asked, columns={**columns, "effort_f": asked["effort"]})
    monkeypatch.setattr(friction_library, "smoothed", lambda torque, *_, **__: torque)
    expected = model.predict(asked).effort
    assert _warmer(traced, (q, qd, qdd), celsius - model.law_.celsius) == pytest.approx(
        expected,
        abs=1e-3,  # at reversals a program sees the way back a sample later
    )
    usual = _warmer(traced, (q, qd, qdd), np.zeros_like(q))
    assert np.abs(usual - expected).max() > 0.02


def _warmer(traced: TorchModel, rows, warmer) -> np.ndarray:
    """Efforts of a stream whose joints are so much warmer than in the training [K]."""
    start = 0
    for name, size in traced.state:
        if name == "warmer_k":
            break
        start += size
    state = torch.zeros(1, traced.state_size, dtype=torch.float64)
    load, efforts = torch.tensor(load_row(Payload())), []
    for *sample, warm in zip(*rows, warmer, strict=True):
        state[0, start : start + len(warm)] = torch.tensor(warm)
        effort, state = traced.module(*(torch.tensor(one[None]) for one in sample), load, state)
        efforts.append(effort[0].detach().numpy())
    return np.array(efforts)


@pytest.mark.thorough
def test_what_torch_pickles_as_a_rule_is_found() -> None:
    usual = io.BytesIO()
    program = torch.export.export(torch.nn.Linear(2, 2), (torch.zeros(1, 2),))
    torch.export.save(program, usual)
    assert pickles(usual.getvalue()) == ["archive/data/sample_inputs/model.pt"]
