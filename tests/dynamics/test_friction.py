"""Friction columns."""

import numpy as np
import pytest

from hil.dynamics import friction_terms, joint_columns

QD = np.array([[0.5, -0.002], [0.0, -1.0], [0.01, 0.3]])


def test_coulomb_term_is_a_smooth_sign_of_the_given_width():
    coulomb = friction_terms(QD, sign_width=0.01)["coulomb"]
    assert coulomb[0, 0] == pytest.approx(1.0)
    assert coulomb[1, 1] == pytest.approx(-1.0)
    assert coulomb[1, 0] == 0.0
    assert coulomb[2, 0] == pytest.approx(np.tanh(1.0))


def test_width_zero_is_the_hard_sign():
    np.testing.assert_array_equal(friction_terms(QD, 0.0)["coulomb"], np.sign(QD))


def test_columns_times_coefficients_is_the_friction_law_of_each_joint():
    fc, fv, f0 = np.array([3.0, 5.0]), np.array([7.0, 11.0]), np.array([0.1, -0.2])
    expected = fc * np.tanh(QD / 0.02) + fv * QD + f0
    columns = joint_columns(friction_terms(QD, sign_width=0.02))
    assert columns.shape == (6, 6)
    coefficients = np.stack([fc, fv, f0], axis=1).ravel()  # joint by joint
    np.testing.assert_allclose(columns @ coefficients, expected.ravel())


def test_every_joint_has_columns_of_its_own():
    columns = joint_columns({"a": QD, "b": QD**2}).reshape(3, 2, 2, 2)
    assert not columns[:, 0, 1].any()
    assert not columns[:, 1, 0].any()
    np.testing.assert_array_equal(columns[:, 1, 1, 1], QD[:, 1] ** 2)
