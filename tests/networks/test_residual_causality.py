"""What a residual network's output may depend on, and what it may not."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.residual_parts import OFFSETS, ROWS, motions, random_network, small

pytest.importorskip("torch", reason="torch is not installed")

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
