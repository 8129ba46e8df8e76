"""`hil bench lagrangian` times the same torque for all; how much quicker ours is, in the proof."""

import sys

import pytest

from tests.support.paths import ROOT

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.cli.bench import measure  # noqa: E402
from hil.core.errors import FitError  # noqa: E402

pytestmark = pytest.mark.filterwarnings(  # torch.func.jvp itself, when it is first used
    "ignore:.torch.jit.script. is deprecated:DeprecationWarning"
)


@pytest.fixture
def speed(monkeypatch):
    """The contestants."""
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.lagrangian_peers import speed

    yield speed
    for name in [name for name in sys.modules if name.startswith("benchmarks")]:
        del sys.modules[name]


@pytest.mark.thorough
def test_everybody_computes_the_same_gradient_of_the_weights(speed) -> None:
    rows, told = speed.motion(5), {}
    everybody = speed.contestants()
    net = everybody["ours"]
    for name, torque in everybody.items():
        net.zero_grad()
        torque(*rows).square().sum().backward()
        told[name] = net.trunk.layers[0].weight.grad.clone()
    for gradient in told.values():
        torch.testing.assert_close(gradient, told["ours"], rtol=1e-3, atol=1e-2)


def test_a_contestant_who_computes_something_else_is_refused(speed, monkeypatch) -> None:
    monkeypatch.setattr(speed, "by_jvp", lambda net: lambda q, qd, qdd: 1.001 * net(q, qd, qdd))
    with pytest.raises(FitError, match="torch_func_jvp disagrees"):
        speed.contestants()


def test_every_pass_of_everybody_is_timed(speed, monkeypatch) -> None:
    net = speed.LagrangianNetwork(speed.JOINTS)
    jacobians = speed.LayerJacobian(net, lean=False)
    monkeypatch.setattr(speed, "contestants", lambda: {"ours": net, "theirs": jacobians})
    told = speed.times(4, budget_s=0.1, rounds=2)
    assert set(told) == {"ours_forward", "ours_both", "theirs_forward", "theirs_both"}
    assert min(told.values()) > 0.0


def test_who_does_not_reach_the_error_is_charged_for_all_his_time(speed, monkeypatch) -> None:
    from benchmarks import lagrangian
    from benchmarks.lagrangian_peers import training

    def course(name, seed, limit_s, quick):
        slow = 1.0 if name == "ours" else 0.3
        return training.Course([0.0, 2.0, 60.0], [1.0, 0.95 - 0.1 * slow, 0.85 + 0.1 * (1 - slow)])

    monkeypatch.setattr(training, "course", course)
    figures, ratios = lagrangian._training(quick=True, seeds=[1])
    assert (figures["ours_reached"], figures["ours_cpu_s"]) == (1.0, 2.0)
    assert (figures["literal_reached"], figures["literal_cpu_s"]) == (0.0, 60.0)
    assert ratios["time_vs_literal"] == pytest.approx(30.0)


@pytest.mark.proof
@pytest.mark.timeout(1200)
def test_ours_is_twelve_times_quicker_than_layer_jacobians_and_twice_torch_func() -> None:
    document = measure("lagrangian")
    ratios = document["ratios"]
    for kind in ("forward", "both"):
        assert ratios[f"vs_layer_jacobian_{kind}_512"] >= 12
        for peer in ("torch_func_jvp", "torch_func_hessian"):
            assert ratios[f"vs_{peer}_{kind}_512"] >= 2
    assert document["figures"]["ours_reached"] == 1
    assert ratios["time_vs_literal"] > 1
