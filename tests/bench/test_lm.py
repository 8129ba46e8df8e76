"""`hil bench lm` starts all programs at the same weights; the proof compares their times."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from hil.cli.bench import measure
from hil.networks.mlp import Mlp
from tests.support.paths import ROOT


@pytest.fixture
def peers(monkeypatch):
    """The contestants' modules, as their own processes import them."""
    pytest.importorskip("pyrenn", reason="pyrenn is not installed", exc_type=ImportError)
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.lm_peers import course, with_pyrenn

    yield course, with_pyrenn
    for name in [name for name in sys.modules if name.startswith("benchmarks")]:
        del sys.modules[name]


def test_a_matrix_that_is_not_definite_is_a_failed_step_of_torchs(monkeypatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.lm_peers.with_torch import damped_step

    H, g = torch.diag(torch.tensor([4.0, 2.0])), torch.tensor([4.0, 1.0])
    assert damped_step(H, g).tolist() == pytest.approx([1.0, 0.5])
    assert damped_step(H - 3.0 * torch.eye(2), g) is None


@pytest.mark.thorough
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux only")
def test_a_contestant_does_not_inherit_the_memory_of_who_started_it() -> None:
    ballast = np.ones(400 * 2**17)  # 400 MiB
    code = "from benchmarks.lm_peers.course import peak_mib; print(peak_mib())"
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    )
    assert 10 < float(told.stdout) < ballast.nbytes / 2**20


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_pyrenn_starts_from_the_same_function(peers) -> None:
    course, with_pyrenn = peers
    rows = course.problem(course.Terms(poses=30, seed=2, iterations=1, limit_s=9.0, target=0.0))
    net = with_pyrenn.pyrenn_module().CreateNN(list(course.LAYERS))
    net["w"] = with_pyrenn.as_pyrenn(rows)
    data, net = with_pyrenn.pyrenn_module().prepare_data(rows.X.T, rows.y[None], net)
    cost = with_pyrenn.pyrenn_module().calc_error(net, data)
    ours = Mlp(course.LAYERS).predict(rows.start[None], rows.scaling.inputs(rows.X))
    error = rows.scaling.outputs(ours)[:, 0] - rows.y
    assert with_pyrenn.target_norm(rows) ** 2 * cost == pytest.approx(np.sum(error**2))


def test_several_seeds_are_told_apart_with_the_median_of_their_ratios(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks import lm

    def course(name, poses, seed, iterations, target=0.0):
        return lm.Course(cpu_s=[0.0, 10.0 * (seed + 1) if name == "pyrenn" else 1.0], rmse=[9, 1.0])

    monkeypatch.setattr(lm, "_course", course)
    document = lm.run(quick=True, seeds=[0, 4, 1])
    told = {f"{seed}_ours_plain_vs_pyrenn" for seed in ("seed0", "seed1", "seed4", "median")}
    assert told <= document["ratios"].keys()
    assert document["ratios"]["median_ours_plain_vs_pyrenn"] == pytest.approx(20.0)
    assert "seed4_pyrenn_cpu_s" in document["figures"]
    assert "ours_plain_vs_pyrenn" in lm.run(quick=True)["ratios"]


@pytest.mark.proof
def test_everybody_gets_to_the_same_error() -> None:
    document = measure("lm", quick=True)
    figures = document["figures"]
    assert figures["rows"] == 600
    for name in ("ours_averaged", "ours_plain"):
        assert 0 < figures[f"{name}_cpu_s"] < np.inf
    peers = {"pyrenn", "torch_vmap_jacrev"}
    assert peers == {name for name in peers if f"{name}_cpu_s" in figures} | set(
        document["skipped"]
    )


@pytest.mark.proof
@pytest.mark.timeout(1800)
def test_ours_is_forty_times_sooner_with_averaging_and_ten_times_without() -> None:
    document = measure("lm")
    assert document["ratios"]["ours_averaged_vs_pyrenn"] >= 40
    assert document["ratios"]["ours_plain_vs_pyrenn"] >= 10


@pytest.mark.proof
@pytest.mark.timeout(1800)
def test_six_joints_and_a_thousand_epochs_take_under_three_minutes_on_two_cores() -> None:
    """CPU time on one core, twice what two cores need: a busy machine is no excuse then."""
    import time

    from hil.networks.lm import train

    random = np.random.default_rng(0)
    # Poses approached from both sides, whose friction differs: a target that no function of the
    # position meets, so that training goes on to the last epoch.
    dwell = np.repeat(np.arange(1300), 5)
    pose = np.repeat(random.uniform(-np.pi, np.pi, (650, 4)), 2, axis=0)
    X = (pose + 2e-4 * random.standard_normal(pose.shape))[dwell]
    Y = random.uniform(-0.15, 0.15, (1300, 6))[dwell] + 0.005 * random.standard_normal((6500, 6))
    begin = time.process_time()
    with threadpool_limits(1):
        trained = train(Mlp((4, 20, 20, 10, 1)), X, Y, groups=dwell, epochs=1000)
    assert time.process_time() - begin < 2 * 180
    assert [history.epochs for history in trained.histories] == [1000] * 6
