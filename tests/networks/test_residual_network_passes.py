"""The residual network in torch, in numpy and sample by sample, against the definition."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hil.core.errors import DataError, SpecError
from hil.networks.residual_tcn import RingTcn, TrainedTcn
from tests.support.residual_parts import OFFSETS, motions, problem, random_network, small

torch = pytest.importorskip("torch", reason="torch is not installed")

KINDS = [
    {"layout": layout, "inputs": inputs, "split": split, "activation": activation}
    for layout, inputs, split, activation in (
        ("grouped", "motion", True, "tanh"),
        ("grouped", "history", False, "relu"),
        ("joint", "measured", True, "relu"),
        ("joint", "history", True, "tanh"),
        ("joint", "motion", False, "tanh"),
    )
]


def by_definition(network, inputs):
    """Eq. 26 sample by sample in Python, with the first sample repeated before the series."""
    w = network.weights
    act = np.tanh if w.activation == "tanh" else (lambda v: np.maximum(v, 0.0))
    before = network.settings.window - 1
    x = np.concatenate([np.repeat(inputs[:1], before, axis=0), inputs])
    h = np.einsum("gcf,tgf->tgc", w.enter.astype(float), x) + w.enter_bias
    for taps, bias, d in zip(w.taps, w.biases, w.dilations, strict=True):
        kernel = taps.shape[-1]
        new = h.copy()
        for t in range((kernel - 1) * d, len(h)):
            # f(i) weighs x(t - d·i): the last tap is the newest.
            total = bias.astype(float)
            for i in range(kernel):
                total = total + np.einsum("gcd,gd->gc", taps[..., kernel - 1 - i], h[t - d * i])
            new[t] = act(total) + h[t]
        h = new
    return (np.einsum("goc,tgc->tgo", w.leave, h) + w.leave_bias)[before:]


def test_a_pass_over_a_series_is_the_dilated_convolution_of_the_paper() -> None:
    network = random_network(small(split=False))
    inputs = np.random.default_rng(0).normal(size=(40, *network.weights.enter.shape[::2]))
    assert network.weights.series(inputs) == pytest.approx(by_definition(network, inputs), abs=1e-4)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "-".join(map(str, kind.values())))
def test_sample_by_sample_equals_the_pass_over_the_series(kind) -> None:
    recorded = motions()
    network = random_network(small(**kind, latency_s=0.003), recorded)
    whole = network.predict(recorded)
    columns = (recorded.q, recorded.qd, recorded.qdd, recorded.base, recorded.effort)
    for start, stop in pairwise(OFFSETS):
        ring = RingTcn(network)
        steps = [ring.step(*(column[k] for column in columns)) for k in range(start, stop)]
        assert np.array(steps) == pytest.approx(whole[start:stop], abs=1e-5 * np.abs(whole).max())


@pytest.mark.parametrize("every", [1, 2, 4])
def test_torch_gives_what_numpy_gives_at_every_so_manyth_sample(every) -> None:
    made = problem(small(split=False))
    random = np.random.default_rng(1)
    with torch.no_grad():
        made.module.leave.copy_(torch.as_tensor(random.normal(size=made.module.leave.shape)))
    groups, _, features = made.module.enter.shape
    x = random.normal(size=(groups, features, made.settings.window + 4 * 9)).astype(np.float32)
    with torch.no_grad():
        found = made.module(torch.as_tensor(x)[None], every)[0].numpy()
    expected = made.module.weights().forward(x)[..., ::every]
    assert found == pytest.approx(expected[..., : found.shape[-1]], abs=1e-5)
    assert found.shape[-1] == expected.shape[-1]


def test_a_long_series_in_pieces_gives_what_it_gives_at_once(monkeypatch) -> None:
    recorded = motions()
    network = random_network(small(), recorded)
    whole = network.predict(recorded)
    monkeypatch.setattr("hil.networks.residual_tcn.CHUNK", 37)
    assert network.predict(recorded) == pytest.approx(whole, abs=1e-5)


def test_an_arm_that_starts_from_rest_is_taken_to_have_been_at_rest() -> None:
    recorded = motions(offsets=np.array([0, 50]))
    still = replace(recorded, **{k: np.zeros((50, 2)) for k in ("q", "qd", "qdd", "base")})
    out = random_network(small(), recorded).predict(still)
    assert np.ptp(out, axis=0) == pytest.approx([0.0, 0.0], abs=1e-6)


def test_an_untrained_network_adds_nothing() -> None:
    assert np.all(problem(small()).trained().predict(motions()) == 0.0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: "-".join(map(str, kind.values())))
def test_stored_arrays_bring_the_same_network_back(kind) -> None:
    recorded = motions()
    network = random_network(small(**kind), recorded)
    again = TrainedTcn.from_arrays(network.to_arrays(), network.settings.to_json())
    assert np.array_equal(again.predict(recorded), network.predict(recorded))


@pytest.mark.parametrize("name", ["scale", "weights.taps_1", "scales.highest", "rate_hz"])
def test_an_array_that_is_missing_is_told(name) -> None:
    network = random_network(small())
    arrays = network.to_arrays()
    del arrays[name]
    with pytest.raises(DataError, match=name.rpartition(".")[2]):
        TrainedTcn.from_arrays(arrays, network.settings.to_json())


@pytest.mark.parametrize("name", ["scale", "weights.enter", "weights.leave_bias", "scales.qd"])
def test_an_array_of_another_shape_is_told(name) -> None:
    network = random_network(small())
    arrays = network.to_arrays()
    arrays[name] = arrays[name][:-1]
    with pytest.raises(DataError, match="residual network"):
        TrainedTcn.from_arrays(arrays, network.settings.to_json())


def test_another_sample_rate_is_refused() -> None:
    with pytest.raises(DataError, match=r"trained at 1000 Hz.*come at 500 Hz"):
        random_network(small()).predict(replace(motions(), rate_hz=500.0))


def test_a_step_without_the_torque_it_hears_is_refused() -> None:
    with pytest.raises(DataError, match="inputs: history"):
        RingTcn(random_network(small(inputs="history"))).step(*np.zeros((4, 2)))


def test_settings_that_cannot_be_are_told() -> None:
    with pytest.raises(SpecError, match="'histroy'"):
        small(inputs="histroy")
    with pytest.raises(SpecError, match="every is 3, but must divide the dilations 4"):
        small(every=3)
    with pytest.raises(SpecError, match="no parameter 'dilation'"):
        type(small()).given({"dilation": [1]})


def test_settings_come_back_from_json() -> None:
    settings = small(every=2, f_cut_hz=3.0)
    listed = {k: list(v) if isinstance(v, tuple) else v for k, v in settings.to_json().items()}
    assert type(settings).given(listed) == settings


@pytest.mark.parametrize(
    ("inputs", "label"),
    [
        ("motion", "honest"),
        ("history", "honest: torque history ending at least 20 ms before"),
        ("measured", "paper: measured torque among the inputs"),
    ],
)
def test_what_is_heard_labels_the_model(inputs, label) -> None:
    assert small(inputs=inputs).protocol == label
