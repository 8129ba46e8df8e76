"""Dahl's state in place of sign(qd): where it begins, and the length that is found for it."""

import numpy as np

from hil.data import Conditions
from hil.data.filters import FilterSettings, prepare
from hil.networks.lagrangian_data import (
    LENGTHS_RAD,
    carried_directions,
    fitted_lengths,
    smooth_sign,
)
from tests.support.synthetic_memory import dahl_loop, stopping
from tests.support.synthetic_motion import COULOMB, GAINS, OFFSET, VISCOUS, dataset, nominal, plant


def moved(length, *seeds, noise_nm=0.05):
    """Rigid body, Dahl friction of one length per joint, viscous friction; prepared."""
    columns, conditions = {}, []
    for seed in seeds:
        t, q, qd, qdd = stopping(seed)
        torque = plant().inverse_dynamics(q, qd, qdd) + dahl_loop(q, length) * COULOMB
        torque += VISCOUS * qd + OFFSET
        torque += noise_nm * np.random.default_rng(seed).normal(size=torque.shape)
        for name, values in {"t": t, "q": q, "qd": qd, "effort": torque / GAINS}.items():
            columns.setdefault(name, []).append(values)
        conditions.append(Conditions(f"t{seed}", "trajectory", f"run{seed}", seed))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    data = dataset(joined, [len(columns["t"][0])] * len(seeds), conditions)
    exact = {"q_f": joined["q"], "qd_f": joined["qd"], "qdd_f": np.zeros_like(joined["q"])}
    exact["qdd_f"] = prepare(data, FilterSettings())["qdd_f"]
    return data.with_columns(**exact, effort_f=joined["effort"])


def test_the_length_of_every_joint_is_found() -> None:
    length = LENGTHS_RAD[[7, 8, 9, 7, 8, 9]]
    data = moved(length, 1)
    torque, rows = data["effort"] * GAINS, np.arange(len(data))
    assert np.array_equal(fitted_lengths(data, torque, rows, nominal()), length)


def test_states_begin_afresh_with_every_series() -> None:
    length = np.full(6, 3e-3)
    both, second = moved(length, 1, 2), moved(length, 2)
    states = carried_directions(both, length)
    assert np.array_equal(states[len(second) :], carried_directions(second, length))
    assert np.array_equal(states[len(second)], np.zeros(6))


def test_states_are_dahls_equation_along_the_path() -> None:
    data = moved(np.full(6, 3e-3), 3)
    loop = dahl_loop(data["q"], 3e-3)
    # The path is summed up from velocities: a little off where joints turn round.
    assert np.sqrt(np.mean((carried_directions(data, np.full(6, 3e-3)) - loop) ** 2)) < 0.02


def test_the_smooth_sign_of_width_zero_is_the_sign() -> None:
    speeds = np.array([[-2.0, -1e-9, 0.0, 1e-9, 2.0]])
    assert np.array_equal(smooth_sign(speeds, 0.0), np.sign(speeds))
    assert np.allclose(smooth_sign(speeds, 0.01), [[-1.0, -1e-7, 0.0, 1e-7, 1.0]])
