"""The residual network: passes in torch, numpy and sample by sample, causality, crops, training."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hil.core.errors import DataError, SpecError
from hil.networks.residual_data import Motions, Segments, motion_frequency, slow_and_fast
from hil.networks.residual_tcn import RingTcn, TrainedTcn
from tests.support.residual_parts import OFFSETS, ROWS, motions, problem, random_network, small
from tests.support.synthetic_motion import moving

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.residual_training import ResidualProblem  # noqa: E402
from hil.networks.training import TrainingSettings, joint_stages  # noqa: E402
from hil.networks.training_loop import train  # noqa: E402

# Passes, against the definition

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
    with pytest.raises(DataError, match=r"trained at 1000 Hz.*sample rate is 500 Hz"):
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


# What an output may depend on, and what it may not

AT = 150
"""A row in the middle of the first series."""

LAYOUTS = ("grouped", "joint")
LAG = 7
HEARING = {"latency_s": LAG * 1e-3}


def changed(recorded, rows, names=("q", "qd", "qdd", "base"), by=0.3):
    """The recording with columns changed in some rows."""
    new = {}
    for name in names:
        new[name] = getattr(recorded, name).copy()
        new[name][rows] += by
    return replace(recorded, **new)


def touched(settings, recorded, rows, names) -> np.ndarray:
    """Rows whose output changes when columns change in some rows."""
    network = random_network(settings, recorded)
    before, after = (network.predict(m) for m in (recorded, changed(recorded, rows, names)))
    return np.flatnonzero(np.any(np.abs(after - before) > 1e-6, axis=1))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("inputs", ["motion", "history", "measured"])
def test_no_output_depends_on_later_input(layout, inputs) -> None:
    settings = small(layout=layout, inputs=inputs, **HEARING)
    names = ("q", "qd", "qdd", "base", "effort")
    found = touched(settings, motions(), slice(AT, ROWS), names)
    assert found.min() == AT


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_output_depends_on_the_window_before_it_and_no_further_back(layout) -> None:
    settings = small(layout=layout)
    found = touched(settings, motions(), AT, ("qd",))
    assert found.min() == AT
    assert found.max() == AT + settings.window - 1


@pytest.mark.parametrize("layout", LAYOUTS)
def test_without_torque_among_its_inputs_no_output_depends_on_torque(layout) -> None:
    settings = small(layout=layout, inputs="motion")
    assert len(touched(settings, motions(), slice(0, ROWS), ("effort",))) == 0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_torque_is_heard_once_the_latency_has_passed_and_not_before(layout) -> None:
    settings = small(layout=layout, inputs="history", **HEARING)
    found = touched(settings, motions(), slice(AT, ROWS), ("effort",))
    assert found[found < OFFSETS[1]].min() == AT + LAG


@pytest.mark.parametrize("layout", LAYOUTS)
def test_as_published_the_torque_of_the_same_instant_is_heard(layout) -> None:
    settings = small(layout=layout, inputs="measured")
    assert touched(settings, motions(), slice(AT, ROWS), ("effort",)).min() == AT


def test_a_latency_between_two_samples_counts_as_the_later_one() -> None:
    assert small(inputs="history", latency_s=0.0203).lag(1000.0) == 21
    assert small(inputs="history", latency_s=0.02).lag(999.9999) == 20
    assert small(inputs="history", latency_s=1e-5).lag(100.0) == 1


def test_memory_does_not_reach_from_one_series_into_the_next() -> None:
    found = touched(small(inputs="history"), motions(), slice(0, OFFSETS[1]), ("qd", "effort"))
    assert found.max() < OFFSETS[1]


def test_a_joints_own_network_sees_no_other_joint() -> None:
    recorded = motions()
    network = random_network(small(), recorded)
    other = changed(recorded, (slice(None), 0))
    difference = np.abs(network.predict(other) - network.predict(recorded)).max(axis=0)
    assert difference[0] > 1e-3
    assert difference[1] == 0.0


def test_one_network_for_all_sees_the_other_joints() -> None:
    recorded = motions()
    network = random_network(small(layout="joint"), recorded)
    other = changed(recorded, (slice(None), 0))
    assert np.all(np.abs(network.predict(other) - network.predict(recorded)).max(axis=0) > 1e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_beyond_the_range_it_was_trained_in_an_input_is_held_at_its_end(side) -> None:
    recorded = motions()
    network = random_network(small(base_input=False), recorded)
    far, farther = (
        changed(recorded, slice(None), ("qd", "qdd"), by=side * by) for by in (1e3, 1e6)
    )
    assert np.array_equal(network.predict(far), network.predict(farther))


# What it learns from: crops of recordings, slow and fast parts of a residual

T = np.arange(4000) / 1000.0
HEARD = ("motion", "history", "measured")
STEADY = np.array([0, 4000])
ALL = np.ones(4000, dtype=bool)


def swinging(*waves: tuple[float, float]) -> Motions:
    """One joint whose velocity is a sum of sines, each (amplitude, frequency)."""
    qd = sum(a * np.sin(2 * np.pi * f * T) for a, f in waves)[:, None]
    return Motions(qd, qd, qd, qd, None, STEADY, 1000.0)


def test_the_motions_frequency_is_that_of_its_fastest_wave() -> None:
    assert motion_frequency(swinging((1.0, 0.5), (1.0, 3.0)), ALL) == pytest.approx(3.0, abs=0.6)


def test_waves_of_no_consequence_do_not_count_as_motion() -> None:
    assert motion_frequency(swinging((1.0, 3.0), (0.01, 80.0)), ALL) == pytest.approx(3.0, abs=0.6)


def test_a_motion_that_is_none_has_no_frequency() -> None:
    with pytest.raises(DataError, match="no joint moves"):
        motion_frequency(swinging((0.0, 1.0)), ALL)


def test_series_that_teach_nothing_have_no_say_in_the_motions_frequency() -> None:
    slow, fast = swinging((1.0, 0.5)), swinging((1.0, 20.0))
    qd = np.concatenate([slow.qd, fast.qd])
    both = Motions(qd, qd, qd, qd, None, np.array([0, 4000, 8000]), 1000.0)
    found = motion_frequency(both, np.arange(8000) < 4000)
    assert found == pytest.approx(motion_frequency(slow, ALL))


def test_waves_are_parted_where_rows_to_learn_from_are_drawn_one_by_one() -> None:
    slow, fast = np.sin(2 * np.pi * 0.5 * T), 0.2 * np.sin(2 * np.pi * 25 * T)
    learn = np.random.default_rng(0).random(4000) < 0.6
    parts = slow_and_fast((slow + fast)[:, None], swinging((1.0, 0.5)), 5.0, learn)
    inner = learn & (T > 0.5) & (T < 3.5)
    assert parts[0, inner, 0] == pytest.approx(slow[inner], abs=0.02)


def test_slow_and_fast_waves_are_parted() -> None:
    waves = swinging((1.0, 0.5))
    slow, fast = np.sin(2 * np.pi * 0.5 * T), 0.2 * np.sin(2 * np.pi * 60 * T)
    parts = slow_and_fast((slow + fast)[:, None], waves, 6.0, ALL)[:, 500:-500, 0]
    assert parts[0] == pytest.approx(slow[500:-500], abs=5e-3)
    assert parts[1] == pytest.approx(fast[500:-500], abs=5e-3)


def test_what_is_slow_is_slow_where_a_series_begins_and_ends_as_well() -> None:
    slow = np.sin(2 * np.pi * 0.125 * T)[:, None]
    fast = slow_and_fast(slow, swinging((1.0, 0.125)), 0.6, ALL)[1]
    assert np.abs(fast[:500]).max() < 0.02
    assert np.abs(fast[-500:]).max() < 0.02


@pytest.mark.parametrize("f_cut_hz", [0.2, 5.0, 450.0])
def test_slow_and_fast_add_up(f_cut_hz) -> None:
    residual = np.random.default_rng(0).normal(size=(ROWS, 2))
    learn = np.random.default_rng(1).random(ROWS) < 0.6
    parts = slow_and_fast(residual, motions(), f_cut_hz, learn)
    assert parts.sum(axis=0) == pytest.approx(residual, abs=1e-12)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_no_row_is_learned_from_twice_nor_one_that_must_not(every) -> None:
    allowed = np.random.default_rng(0).random(ROWS) < 0.6
    crops = Segments.of(motions(), allowed, small(every=every))
    rows = crops.rows[crops.counted]
    assert len(np.unique(rows)) == len(rows)
    assert np.all(allowed[rows])


def test_with_every_instant_all_rows_are_learned_from() -> None:
    allowed = np.random.default_rng(0).random(ROWS) < 0.6
    crops = Segments.of(motions(), allowed, small(every=1))
    assert np.array_equal(np.sort(crops.rows[crops.counted]), np.flatnonzero(allowed))


def test_instants_far_apart_have_every_phase() -> None:
    crops = Segments.of(motions(), np.ones(ROWS, dtype=bool), small(every=4))
    rows = crops.rows[crops.counted]
    assert set((rows[rows < OFFSETS[1]] % 4).tolist()) == {0, 1, 2, 3}
    assert len(rows) == pytest.approx(ROWS / 4, abs=8)


def test_instants_are_as_far_apart_as_the_sample_rate_allows() -> None:
    assert [small().apart(rate) for rate in (1000.0, 500.0, 125.0)] == [4, 2, 1]


def test_a_history_of_torque_is_as_recorded_and_the_papers_torque_is_filtered() -> None:
    recorded = moving(0)
    data = recorded.with_columns(effort_f=recorded["effort"] + 1.0)
    base = np.zeros_like(data["q"])
    heard = {k: Motions.of(data, base, small(inputs=k)).effort for k in HEARD}
    assert heard["motion"] is None
    assert heard["history"] is data["effort"]
    assert heard["measured"] is data["effort_f"]


# As a problem for the training loop


def stepped(made, steps: int = 5, rate: float = 3e-3) -> None:
    """A few steps with all crops."""
    adam = torch.optim.Adam(made.module.parameters(), lr=rate)
    for _ in range(steps):
        adam.zero_grad()
        made.loss(torch.arange(made.samples)).backward()
        adam.step()


@pytest.mark.parametrize("split", [True, False])
@pytest.mark.parametrize("layout", ["grouped", "joint"])
def test_validation_is_the_error_of_predictions_in_the_rows_to_stop_by(layout, split) -> None:
    made = problem(small(layout=layout, split=split, every=1))
    stepped(made)
    error = (made.motions.effort - made.motions.base) - made.trained().predict(made.motions)
    expected = np.sqrt(np.mean(error[ROWS // 2 :] ** 2, axis=0))
    assert made.validation_errors() == pytest.approx(expected, rel=1e-4)


def test_the_loss_is_the_mean_square_of_errors_over_the_residuals_size() -> None:
    made = problem(small(split=False, every=1))
    stepped(made)
    residual = (made.motions.effort - made.motions.base)[: ROWS // 2]
    error = residual - made.trained().predict(made.motions)[: ROWS // 2]
    expected = np.mean(error**2 / np.mean(residual**2, axis=0))
    assert made.loss(torch.arange(made.samples)).item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("layout", ["grouped", "joint"])
def test_rows_to_stop_by_do_not_teach(layout) -> None:
    recorded = motions()
    other = {name: getattr(recorded, name).copy() for name in ("q", "qd", "qdd", "base", "effort")}
    for values in other.values():
        values[OFFSETS[2] :] = values[OFFSETS[2] :] * 3.0 + 1.0
        values[OFFSETS[2] :: 2] *= -1.0
    learn = np.arange(ROWS) < OFFSETS[1]
    taught = [
        _taught(
            found,
            learn,
            np.arange(ROWS) >= OFFSETS[2],
            small(layout=layout, split=True, inputs="history"),
        )
        for found in (recorded, replace(recorded, **other))
    ]
    assert all(np.array_equal(taught[0][name], taught[1][name]) for name in taught[0])


@pytest.mark.parametrize("torn", [True, False])
def test_torque_of_rows_that_are_not_learned_from_does_not_teach(torn) -> None:
    """Within one series: rows drawn one by one, or its end."""
    recorded = motions(offsets=np.array([0, ROWS]))
    learn = np.random.default_rng(2).random(ROWS) < 0.6 if torn else np.arange(ROWS) < 400
    effort = np.where(learn[:, None], recorded.effort, 3.0 * recorded.effort + 1.0)
    taught = [
        _taught(found, learn, ~learn, small(layout="joint"))
        for found in (recorded, replace(recorded, effort=effort))
    ]
    assert all(np.array_equal(taught[0][name], taught[1][name]) for name in taught[0])


def _taught(found, learn, validate, settings):
    made = ResidualProblem(found, found.effort - found.base, learn, validate, settings)
    stepped(made)
    return made.trained().to_arrays()


def _with_rows(found, learn, validate):
    settings = small(inputs="history", f_cut_hz=5.0)
    return ResidualProblem(found, found.effort - found.base, learn, validate, settings)


def test_equal_seeds_give_equal_networks_and_other_seeds_others() -> None:
    found = []
    for seed in (3, 3, 4):
        made = problem(small(), seed=seed)
        stepped(made)
        found.append(made.trained().predict(made.motions))
    assert np.array_equal(found[0], found[1])
    assert not np.allclose(found[0], found[2])


@pytest.mark.parametrize("name", ["q", "base", "effort"])
def test_values_that_are_not_finite_are_told(name) -> None:
    recorded = motions()
    residual = recorded.effort - recorded.base
    getattr(recorded, name)[3, 1] = np.nan
    learn = np.arange(ROWS) < OFFSETS[1]
    with pytest.raises(DataError, match=f"{name} of the residual network is not finite"):
        ResidualProblem(recorded, residual, learn, ~learn, small())


def test_rows_to_stop_by_are_needed() -> None:
    with pytest.raises(DataError, match="rows for early stopping"):
        _with_rows(motions(), np.ones(ROWS, dtype=bool), np.zeros(ROWS, dtype=bool))


def test_a_joint_that_never_moves_and_has_no_residual_is_learned_as_nothing() -> None:
    recorded = motions()
    for name in ("q", "qd", "qdd", "base", "effort"):
        getattr(recorded, name)[:, 0] = 0.0
    made = problem(small(f_cut_hz=5.0), recorded)
    stepped(made)
    out = made.trained().predict(recorded)
    assert np.all(np.isfinite(out))
    assert np.abs(out[:, 0]).max() < 0.05 * np.abs(out[:, 1]).max()


@pytest.mark.thorough
def test_friction_that_lags_behind_reversals_is_learned_from_motion_alone() -> None:
    """A residual with memory: a first-order lag of sign(q̇), unseen by any memoryless model."""
    recorded, residual = _lagging()
    learn = np.arange(len(recorded)) < len(recorded) // 2
    made = ResidualProblem(recorded, residual, learn, ~learn, small(dilations=(1, 4, 16), every=4))
    before = made.validate()
    settings = TrainingSettings(epochs=30, batch_size=8, learning_rate=1e-2, device="cpu")
    train(made, joint_stages(settings), settings)
    assert made.validate() < 0.35 * before


def _lagging() -> tuple[Motions, np.ndarray]:
    random = np.random.default_rng(0)
    t = np.arange(6000) / 500.0
    phases = random.uniform(0, 6, size=(3, 1))
    qd = np.sin(np.array([[1.7], [4.1], [7.3]]) * t + phases).sum(axis=0)[:, None]
    lagged = np.zeros_like(qd)
    for k in range(1, len(qd)):
        lagged[k] = lagged[k - 1] + (np.sign(qd[k]) - lagged[k - 1]) / 12.0
    friction = lagged - np.sign(qd)
    qdd = np.gradient(qd, 1 / 500.0, axis=0)
    return Motions(qd, qd, qdd, qd, None, np.array([0, 3000, 6000]), 500.0), friction
