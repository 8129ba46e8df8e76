"""Lagrangian networks and shaped friction as PyTorch programs: the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.estimators import estimator  # noqa: E402
from hil.estimators.diffnea_friction import FORMS  # noqa: E402
from hil.export.agreement import golden_of, largest_difference  # noqa: E402
from hil.export.torch_export import export_torch  # noqa: E402
from hil.export.torch_modules import module_of  # noqa: E402
from tests.support.lagrangian_models import CASES, lagrangian  # noqa: E402
from tests.support.synthetic_memory import remembering  # noqa: E402
from tests.support.synthetic_motion import moving, nominal  # noqa: E402


def stepping(module):
    def step(inputs):
        with torch.no_grad():
            return [found.numpy() for found in module(*map(torch.tensor, inputs))]

    return step


def off_by(model) -> float:
    traced, golden = module_of(model), golden_of(model, samples=120)
    return largest_difference(stepping(traced.module), golden, traced.state_size)


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_a_module_says_what_the_network_says(case) -> None:
    assert off_by(lagrangian(case)) < 2e-6


@pytest.mark.thorough
@pytest.mark.parametrize("friction", FORMS)
def test_a_module_says_what_rigid_diffnea_says(friction) -> None:
    data = remembering(1, 2) if friction == "memory" else moving(1, 2)
    model = estimator("rigid-diffnea", friction=friction).fit(data, nominal())
    # The speed within its peak is 1e-9 rad/s off.
    assert off_by(model) < (1e-7 if friction == "memory" else 1e-12)


@pytest.mark.thorough
def test_a_file_says_it_too_and_scatters_nothing(tmp_path) -> None:
    told = export_torch(lagrangian("dissipative"), tmp_path / "arm.pt2")
    assert told.checked
    graph = torch.export.load(tmp_path / "arm.pt2").graph
    used = {str(node.target) for node in graph.nodes if node.op == "call_function"}
    assert not [name for name in used if any(w in name for w in ("index", "gather", "scatter"))]


def test_rows_do_not_hear_of_each_other() -> None:
    module = module_of(lagrangian("dissipative")).module
    random = np.random.default_rng(0)
    rows = [torch.tensor(random.normal(size=(4, size))) for size in (6, 6, 6, 10)]
    (together,) = module(*rows)
    for k in range(4):
        (alone,) = module(*(one[k : k + 1] for one in rows))
        torch.testing.assert_close(alone[0], together[k], rtol=1e-5, atol=1e-5)
