"""Networks refuse data that cannot be, with one error that says what, where and how to mend it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import DataError, FitError, HilError
from hil.data import Dataset
from tests.support.bad_networks import fitted, recorded, spoilt, unfitted
from tests.support.synthetic_motion import dwelling, moving, nominal

pytest.importorskip("torch", reason="torch is not installed")

KINDS = ["lagrangian", "memory", "residual"]
kinds = pytest.mark.parametrize("kind", KINDS)


def refusal(kind: str, data: Dataset) -> HilError:
    with pytest.raises((FitError, DataError)) as caught:
        unfitted(kind).fit(data, nominal())
    assert caught.value.hint
    return caught.value


def scaled(data: Dataset, **by: float) -> Dataset:
    return data.with_columns(**{name: factor * data[name] for name, factor in by.items()})


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", ["t", "q", "qd", "effort"])
def test_a_value_that_is_none_is_told_by_column_row_and_joint(kind, column, value) -> None:
    error = refusal(kind, spoilt(recorded(1, 2), column, value))
    where = "row 31" if column == "t" else "row 31 joint 3"
    assert f"1 values of {column} are not finite, the first in {where}" in error.message


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("column", ["q_f", "qd_f", "qdd_f", "effort_f"])
@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_columns_that_were_filtered_before_are_looked_at_too(kind, column, value) -> None:
    message = refusal(kind, spoilt(moving(1, 2), column, value)).message
    assert column in message
    assert "not finite" in message or "cannot be" in message


@kinds
@pytest.mark.parametrize("column", ["q", "qd", "effort"])
def test_what_is_too_large_in_any_unit_is_refused(kind, column) -> None:
    for data in (spoilt(recorded(1, 2), column, 1e300), scaled(recorded(1, 2), **{column: 1e200})):
        assert f"{column} of " in refusal(kind, data).message


@kinds
def test_an_effort_below_any_resolution_counts_as_none(kind) -> None:
    assert "none was measured" in refusal(kind, scaled(recorded(1, 2), effort=1e-300)).message


@kinds
@pytest.mark.parametrize("stands", ["one", "all"])
def test_joints_that_never_move_are_named(kind, stands) -> None:
    data = recorded(1, 2)
    q = data["q"].copy()
    q[:, 2 if stands == "one" else slice(None)] = 0.3
    message = refusal(kind, data.with_columns(q=q)).message
    assert "elbow_joint" in message
    assert "never moved" in message


@kinds
@pytest.mark.parametrize("how", ["twice", "shuffled", "backwards", "standing"])
def test_time_that_does_not_increase_is_told_with_its_series(kind, how) -> None:
    data = recorded(1, 2)
    t = data["t"].copy()
    first = slice(0, int(data.offsets[1]))
    if how == "twice":
        t[31] = t[30]
    elif how == "shuffled":
        t[first] = np.random.default_rng(0).permutation(t[first])
    else:
        t[first] = -t[first] if how == "backwards" else 1.0
    message = refusal(kind, data.with_columns(t=t)).message
    assert "series trajectory1: " in message
    assert "strictly increasing" in message


@kinds
def test_stamps_that_are_no_seconds_are_told_by_their_rate(kind) -> None:
    assert "at 1e+11 Hz" in refusal(kind, scaled(recorded(1, 2), t=1e-9)).message


def test_rows_that_come_a_minute_apart_are_no_motion_to_the_usual_physics() -> None:
    data = scaled(recorded(1, 2), t=1e5)
    with pytest.raises(DataError, match="too slow") as caught:
        unfitted("residual").set_params(base={"estimator": "rigid-hysteresis"}).fit(data, nominal())
    assert "seconds" in caught.value.hint


@pytest.mark.thorough
def test_rates_that_differ_matter_to_what_counts_samples_alone() -> None:
    data = Dataset.concatenate([recorded(1, 2), scaled(recorded(3), t=2.0)])
    assert "trajectory3 is sampled at 50 Hz" in refusal("residual", data).message
    assert np.all(np.isfinite(unfitted("lagrangian").fit(data, nominal()).sigma_))


@kinds
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data.take([]), "0 samples are too few"),
        (lambda _: recorded(1, 2, samples=20), "40 samples are too few"),
        (lambda _: dwelling(60), "to learn from|needs a motion"),
        (lambda data: replace(data, robot="ur10e"), "recorded on a ur10e"),
        (lambda data: replace(data, joint_names=data.joint_names[::-1]), "list the joints as"),
        (lambda data: replace(data, drive_gains=None), "drive gains .* are unknown"),
        (lambda data: replace(data, drive_gains=np.zeros(6)), "drive gains .* above 0"),
    ],
)
def test_data_that_nothing_can_be_learned_from_are_refused(kind, change, words) -> None:
    assert re.search(words, refusal(kind, change(recorded(1, 2))).message)


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize(
    "change", [lambda _: recorded(1), lambda d: replace(d, columns=without(d))]
)
def test_one_trajectory_and_no_velocity_are_enough(kind, change) -> None:
    model = unfitted(kind).fit(change(recorded(1, 2)), nominal())
    assert np.all(np.isfinite(model.predict(recorded(9)).effort))


def without(data: Dataset) -> dict[str, np.ndarray]:
    return {name: values for name, values in data.columns.items() if name != "qd"}


@pytest.mark.parametrize("column", ["q", "qd", "effort", "q_f"])
@pytest.mark.parametrize("shape", ["narrow", "flat"])
def test_columns_of_another_width_are_no_dataset(column, shape) -> None:
    values = moving(9)[column]
    with pytest.raises(DataError, match=rf"column {column} .* not \(600, 6\)") as caught:
        moving(9).with_columns(**{column: values[:, :5] if shape == "narrow" else values[:, 0]})
    assert caught.value.hint


@pytest.mark.thorough
@kinds
@pytest.mark.parametrize("column", ["t", "q", "qd", "effort"])
def test_a_prediction_is_not_made_of_what_is_none(kind, column) -> None:
    with pytest.raises(DataError, match="series trajectory9: ") as caught:
        fitted(kind).predict(spoilt(recorded(9), column, np.nan))
    assert caught.value.hint


@kinds
@pytest.mark.parametrize("column", ["q_f", "qd_f", "qdd_f"])
def test_a_prediction_without_a_number_is_not_called_valid(kind, column) -> None:
    found = fitted(kind).predict(spoilt(moving(9), column, np.nan))
    assert not np.all(found.valid)
    assert np.all(np.isfinite(found.effort[found.valid]))


@kinds
def test_nothing_is_predicted_of_nothing(kind) -> None:
    for data in (recorded(9), moving(9)):
        assert fitted(kind).predict(data.take([])).effort.shape == (0, 6)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [*KINDS, "on a network"])
def test_another_rate_is_refused_by_what_counts_samples_alone(kind) -> None:
    slow = scaled(moving(9), t=3.0)
    if kind in ("residual", "on a network"):
        with pytest.raises(DataError, match="trained at 100 Hz"):
            fitted(kind).predict(slow)
    else:
        assert np.all(np.isfinite(fitted(kind).predict(slow).effort))


@pytest.mark.parametrize("kind", [*KINDS, "on a network"])
@pytest.mark.parametrize("shapes", [(5, 5, 5), (6, 5, 6), (1, 1, 1), (7, 7, 7), (6, 6, 0)])
def test_a_stream_tells_samples_of_another_width(kind, shapes) -> None:
    with pytest.raises(DataError, match="one number for each of 6 joints") as caught:
        fitted(kind).stream().step(*(np.zeros(n) for n in shapes))
    assert caught.value.hint


def test_positions_of_another_width_have_no_mass_matrix() -> None:
    for q in (np.zeros((3, 5)), np.zeros(6)):
        with pytest.raises(DataError, match=r"must be \(N, 6\)"):
            fitted("lagrangian").mass_matrix(q)
    assert fitted("lagrangian").mass_matrix(np.zeros((0, 6))).shape == (0, 6, 6)
