"""A residual network as C against the same network streamed in Python."""

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.export.c import network_piece
from tests.support.c_programs import SANITIZED, require_sanitizers
from tests.support.random_networks import (
    KINDS,
    TANH,
    built,
    correction,
    motion,
    ran,
    stepped,
    streamed,
)


def close(expected: np.ndarray):
    """Single precision, and sums in another order."""
    return pytest.approx(expected, abs=1e-4 * np.nanmax(np.abs(expected)), nan_ok=True)


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """A small network and its program."""
    networks = correction()
    return networks, built(networks, tmp_path_factory.mktemp("network"))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_the_program_says_what_the_stream_says_and_does_nothing_undefined(kind, tmp_path) -> None:
    require_sanitizers("cc", tmp_path)
    networks, rows = correction(**kind), motion()
    expected = streamed(networks, rows, again=31)
    assert np.ptp(expected[:, networks.kept], axis=0).min() > 0.1
    found = stepped(built(networks, tmp_path, flags=SANITIZED), rows, again=31)
    assert found == close(expected)
    assert np.all(found[:, ~networks.kept] == 0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["grouped", "joint"])
def test_a_network_of_the_usual_size_says_it_too(layout, tmp_path) -> None:
    networks = correction(
        n=6, layout=layout, channels=None, dilations=(1, 4, 16), kernel=5, kept=[1, 1, 1, 1, 0, 1]
    )
    rows = motion(200, n=6)
    program = built(networks, tmp_path, flags=["-O3", "-march=native"])
    assert stepped(program, rows) == close(streamed(networks, rows))


def test_a_reset_begins_with_the_next_sample(usual) -> None:
    networks, program = usual
    rows = motion(40)
    expected = streamed(networks, rows, again=23)
    assert stepped(program, rows, again=23) == close(expected)
    assert np.abs(expected - streamed(networks, rows)).max() > 0.1


def test_what_the_networks_say_is_held_within_their_limits(tmp_path) -> None:
    networks, rows = correction(limit=0.8), motion()
    found = stepped(built(networks, tmp_path), rows)
    assert found == close(streamed(networks, rows))
    assert np.abs(found).max() == 0.8


def test_a_sample_that_is_no_number_is_forgotten_with_the_window(usual) -> None:
    networks, program = usual
    rows = motion(60)
    rows[20, 1] = np.nan
    found = stepped(program, rows)
    assert found == close(streamed(networks, rows))
    window = networks.settings.window
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == list(range(20, 20 + window))


def test_numbers_beyond_single_precision_are_held_in_the_range(usual) -> None:
    networks, program = usual
    rows = motion(20)
    rows[5, 1:] = [[1e300], [-1e300], [1e200]]
    assert stepped(program, rows) + rows[:, 3] == close(streamed(networks, rows) + rows[:, 3])


def test_the_hyperbolic_tangent_is_right_to_one_in_a_million(tmp_path) -> None:
    program = built(correction(), tmp_path, main=TANH)
    x = np.concatenate([np.linspace(-12, 12, 100_001), [-1e30, -1e-30, 0.0, np.inf, -np.inf]])
    x = x.astype(np.float32)
    found = np.frombuffer(ran(program, x), dtype=np.float32)
    assert np.abs(found - np.tanh(x.astype(float))).max() < 1e-6
    assert np.isnan(np.frombuffer(ran(program, x[:1] * np.nan), dtype=np.float32))


def test_where_no_joint_keeps_its_network_nothing_is_added_or_remembered(tmp_path) -> None:
    networks = correction(kept=[False, False, False])
    assert network_piece(networks, 3).state == ""
    assert np.all(stepped(built(networks, tmp_path), motion(5)) == 0.0)


def test_joints_that_keep_none_are_not_computed() -> None:
    whole, one = (network_piece(correction(kept=kept), 3) for kept in (None, [0, 1, 0]))
    assert len(one.constants) < 0.5 * len(whole.constants)


def test_networks_that_hear_torque_are_refused() -> None:
    with pytest.raises(FitError, match=r"inputs: history.*\n?.*inputs: motion"):
        network_piece(correction(inputs="history"), 3)


def test_another_number_of_joints_is_refused() -> None:
    with pytest.raises(ValueError, match="networks of 3 joints, but the robot has 6"):
        network_piece(correction(), 6)
