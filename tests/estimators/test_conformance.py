"""What every registered estimator keeps, whatever it fits: one contract, one table of cases."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

from hil.arms.payload import Payload
from hil.core import json_document, plugins
from hil.core.errors import DataError, FitError, HilError, SpecError
from hil.core.typing import FloatArray
from hil.data import Dataset
from hil.estimators import GROUP, estimator, load_model_file, model_files, save_model
from tests.support.every_estimator import (
    CASES,
    NETWORKS,
    at_rest,
    fitted,
    kind_of,
    known,
    new,
    unfitted,
)
from tests.support.fuzzing import damaged, examples, quick_folder
from tests.support.synthetic_motion import GAINS, LOAD, dwelling, moving, nominal, raw

# A damaged model and a recording of nothing predict what they may: numbers are looked at, not
# warnings.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")

NAMES = plugins.names(GROUP)
WITH_CASE = [name for name in NAMES if name in CASES]
ROUNDING = 1e-9


def parametrised(names: Sequence[str], quick: Callable[[str], bool]) -> pytest.MarkDecorator:
    marked = [pytest.param(n, marks=() if quick(n) else pytest.mark.thorough) for n in names]
    return pytest.mark.parametrize("case", marked)


IN_MOTION = [name for name in WITH_CASE if not at_rest(name)]
STREAMED = [case for case in CASES if CASES[case].stream is not None]
CHEAP = ("rigid-wls", "static-wls", "static-linear", "static-coulomb")
"""Fitted in a few hundredths of a second, so to other data as well in `make test`."""

each_estimator = pytest.mark.parametrize("case", WITH_CASE)
every_case = parametrised([*CASES], lambda case: not CASES[case].thorough)
every_stream = parametrised(STREAMED, lambda case: not CASES[case].thorough)
fits_again = parametrised([*CASES], lambda case: case in NAMES)
fits_others = parametrised(
    [case for case in CASES if not CASES[case].thorough], lambda case: case in CHEAP
)


def test_every_registered_estimator_has_a_case() -> None:
    missing = set(NAMES) - set(CASES)
    assert not missing, f"add {missing} to CASES of tests/support/every_estimator.py"
    assert {case.split()[0] for case in CASES} == set(NAMES)
    assert not any(CASES[name].thorough for name in NAMES)


# Predictions


@pytest.mark.thorough
@every_case
def test_it_predicts_every_row_and_joint_in_the_unit_that_it_was_fitted_to(case: str) -> None:
    model, data = fitted(case), new(case)
    found = model.predict(data)
    assert found.effort.shape == found.std.shape == found.valid.shape == (len(data), 6)
    assert np.all(found.valid)
    assert np.all(np.isfinite(found.effort))
    assert sum(found.components.values()) == pytest.approx(found.effort, abs=ROUNDING)
    assert model.effort_kind_ == data.effort_kind
    assert model.torque_scale_ == pytest.approx(GAINS)
    assert (model.gains_source_, model.joint_names_) == ("the tests", data.joint_names)
    assert model.samples_ > 0


@every_case
def test_of_no_rows_it_predicts_none(case: str) -> None:
    for data in (new(case), raw(new(case))):
        assert fitted(case).predict(data.take([])).effort.shape == (0, 6)


@every_case
def test_a_prediction_without_a_number_is_not_called_valid(case: str) -> None:
    for column in {"q", "qd", "q_f", "qd_f", "qdd_f"} & new(case).columns.keys():
        found = fitted(case).predict(spoilt(new(case), column, np.nan))
        assert np.all(np.isfinite(found.effort[found.valid])), column


@every_case
def test_what_was_measured_is_predicted_with_only_by_models_labelled_so(case: str) -> None:
    model, data = fitted(case), new(case)
    blind = {name: np.full_like(data[name], 7.0) for name in data.columns if "effort" in name}
    found, expected = model.predict(data.with_columns(**blind)), model.predict(data)
    assert np.array_equal(found.effort, expected.effort) or model.protocol != "honest"


@pytest.mark.parametrize("case", sorted(case for case in CASES if CASES[case].stream is None))
def test_a_model_that_needs_more_than_the_motion_has_no_stream(case: str) -> None:
    with pytest.raises(FitError, match=r"streamed|needs the measured current"):
        fitted(case).stream()


@every_stream
def test_a_stream_gives_what_a_prediction_gives(case: str) -> None:
    model, data = fitted(case), new(case)
    if at_rest(case):
        # How a joint came to rest does not matter in a move.
        moves = tuple(replace(c, kind="move") for c in data.conditions)
        data = replace(data, conditions=moves).with_columns(qd=np.full_like(data["q"], 0.5))
    for mounted in (None,) if at_rest(case) else (None, LOAD):
        under = data if mounted is None else loaded(data)
        steps = streamed(case, mounted, motion(case, data, speed=0.5), 60)
        expected = model.predict(under).effort[:60]
        assert np.sqrt(np.mean((steps - expected) ** 2)) <= CASES[case].stream


def streamed(
    case: str, mounted: Payload | None, rows: tuple[FloatArray, ...], several: int
) -> FloatArray:
    stream = fitted(case).stream(mounted)
    return np.array([stream.step(*sample) for sample in list(zip(*rows, strict=True))[:several]])


def motion(case: str, data: Dataset, speed: float = 0.0) -> tuple[FloatArray, ...]:
    if at_rest(case):
        return data["q"], np.full_like(data["q"], speed), np.zeros_like(data["q"])
    return data["q_f"], data["qd_f"], data["qdd_f"]


@every_stream
def test_a_stream_refuses_samples_of_another_width_and_goes_on(case: str) -> None:
    stream, unspoilt = fitted(case).stream(), fitted(case).stream()
    for shapes in ((5, 5, 5), (6, 5, 6), (1, 1, 1), (7, 7, 7), (6, 6, 0)):
        with pytest.raises(DataError, match="one number for each of 6 joints") as caught:
            stream.step(*(np.zeros(n) for n in shapes))
        assert caught.value.hint
    still = 3 * (np.zeros(6),)
    assert np.array_equal(stream.step(*still), unspoilt.step(*still))


# Loads

ALSO: Mapping[str, set[str]] = {
    "rigid-hysteresis": {"friction"},
    "rigid-hysteresis full": {"friction"},
    "rigid-diffnea memory": {"friction"},
    "static-hysteresis": {"friction", "drive"},
    # These hear what the physics predicts, the load included.
    "residual": {"residual"},
    "residual on a network": {"residual"},
    "residual history": {"residual"},
}
"""Other parts of a prediction that a load may change; docs/reference/estimators.md names them."""


def loaded(data: Dataset) -> Dataset:
    return replace(data, conditions=tuple(replace(c, payload=LOAD) for c in data.conditions))


def load_effort(case: str, data: Dataset) -> FloatArray:
    """RNEA(with) − RNEA(without) in units of the effort."""
    rows, bare = motion(case, data), nominal()
    with_load = bare.with_payload(LOAD).inverse_dynamics(*rows)
    return (with_load - bare.inverse_dynamics(*rows)) / GAINS


@every_case
def test_a_declared_load_adds_its_rigid_torque_to_a_prediction(case: str) -> None:
    model, data = fitted(case), new(case)
    bare, under = model.predict(data), model.predict(loaded(data))
    parts = {part: under.components[part] - bare.components[part] for part in under.components}
    expected = load_effort(case, data)
    assert parts.pop("payload") == pytest.approx(expected, abs=ROUNDING)
    changed = {part for part, change in parts.items() if np.max(np.abs(change)) > ROUNDING}
    assert changed <= ALSO.get(case, set())
    if not changed:
        assert under.effort - bare.effort == pytest.approx(expected, abs=ROUNDING)


@every_stream
def test_a_declared_load_adds_as_much_sample_by_sample(case: str) -> None:
    rows = motion(case, new(case))
    # The first dwell, or as many samples of a motion as tell.
    several = 10 if at_rest(case) else 40
    difference = streamed(case, LOAD, rows, several) - streamed(case, None, rows, several)
    expected = load_effort(case, new(case))[:several]
    also = 0.1 * np.max(np.abs(expected)) if case in ALSO else CASES[case].stream
    assert difference == pytest.approx(expected, abs=also)


@pytest.mark.parametrize("case", ["rigid-hysteresis", "static-hysteresis"])
def test_what_grows_with_the_load_is_seen_to_grow(case: str) -> None:
    data = new(case)
    more = fitted(case).predict(loaded(data)).effort - fitted(case).predict(data).effort
    assert np.nanmax(np.abs(more - load_effort(case, data))) > 1e-3


@fits_others
def test_a_declared_load_is_no_part_of_the_arm(case: str) -> None:
    if case in ALSO or "current" in case:
        pytest.skip("more than the payload changes with the load, or it looks at the current")
    data, mounted = known(case), load_effort(case, known(case))
    efforts = {
        name: data[name] + mounted for name in ("effort", "effort_f") if name in data.columns
    }
    model = unfitted(case).fit(loaded(data.with_columns(**efforts)), nominal())
    expected = fitted(case).predict(new(case)).effort
    # A penalty, and a network in single precision, magnify rounding.
    assert model.predict(new(case)).effort == pytest.approx(expected, abs=1e-4)


# Model files


@every_case
def test_a_stored_model_is_the_same_bit_by_bit(case: str, tmp_path: Any) -> None:
    model, data = fitted(case), new(case)
    folder = save_model(model, tmp_path / "model")
    assert {f.name for f in folder.iterdir()} == {"model.json", "model.safetensors"}
    again = load_model_file(folder)
    for one in (data, loaded(data)):
        ours, theirs = model.predict(one), again.predict(one)
        assert np.array_equal(ours.effort, theirs.effort)
        assert np.array_equal(ours.std, theirs.std, equal_nan=True)
        assert ours.components.keys() == theirs.components.keys()
    assert model_files(again) == model_files(model)
    assert again.fitted_facts()["protocol"] == model.protocol
    assert json_document(again.get_params()) == json_document(model.get_params())
    assert (again.protocol, again.notes_) == (model.protocol, model.notes_)
    for name, own in vars(model).items():
        if name.endswith("_") and isinstance(own, np.ndarray):
            assert np.array_equal(getattr(again, name, own), own, equal_nan=True), name
    if hasattr(model, "interval"):
        assert np.array_equal(again.interval(0.9), model.interval(0.9), equal_nan=True)


@fits_again
def test_two_fits_give_the_same_bytes(case: str) -> None:
    assert model_files(unfitted(case).fit(known(case), nominal())) == model_files(fitted(case))


@cache
def stored(case: str) -> tuple[bytes, bytes]:
    """Document and arrays of a model."""
    files = model_files(fitted(case))
    return files["model.json"], files["model.safetensors"]


def outcome(case: str, document: bytes, arrays: bytes) -> FloatArray | HilError:
    """What is predicted with a file or why it is refused; no other error is raised."""
    with quick_folder() as folder:
        (folder / "model.json").write_bytes(document)
        (folder / "model.safetensors").write_bytes(arrays)
        try:
            model = load_model_file(folder)
        except HilError as error:
            return error
    try:
        return model.predict(new(case)).effort
    except (DataError, FitError) as error:
        return error


def is_harmless(case: str, found: FloatArray | HilError) -> bool:
    """Whether a damaged file is refused, or predicts what the whole one does."""
    if isinstance(found, HilError):
        return True
    return np.array_equal(found, unharmed(case))


@cache
def unharmed(case: str) -> FloatArray:
    """What the whole file predicts."""
    return fitted(case).predict(new(case)).effort


def sealed(case: str, arrays: bytes) -> tuple[bytes, bytes]:
    """Arrays with a document that vouches for them."""
    digest = hashlib.sha256(arrays).hexdigest()
    return json.dumps(json.loads(stored(case)[0]) | {"arrays_sha256": digest}).encode(), arrays


@each_estimator
def test_a_file_that_ends_early_is_refused(case: str) -> None:
    document, arrays = stored(case)
    for share in (0.0, 0.3, 0.99):
        short = arrays[: int(share * len(arrays))]
        torn = document[: int(share * len(document))]
        for files in ((torn, arrays), (document, short), sealed(case, short)):
            found = outcome(case, *files)
            assert isinstance(found, DataError)
            assert "/model." in found.message
            assert found.hint


@each_estimator
def test_any_flipped_bit_of_the_arrays_is_found(case: str) -> None:
    document, arrays = stored(case)
    for place in range(0, len(arrays), max(1, len(arrays) // 40)):
        flipped = bytearray(arrays)
        flipped[place] ^= 1 << place % 8
        found = outcome(case, document, bytes(flipped))
        assert isinstance(found, DataError)
        assert "damaged" in found.message


BY_DIGEST_ALONE: Mapping[str, str] = {
    "rigid-hysteresis": "shapes",
    "rigid-diffnea": "gear_rigid",
    "static-coulomb": "celsius load_gravity load_limit",
    "static-hysteresis": "celsius load_gravity load_limit correction_mean correction_scale "
    "correction_weights",
    "static-mlp-lm": "network.input_mean network.input_scale network.target_mean "
    "network.target_scale network.weights",
    # Without it, the sign of the velocity is a smooth one.
    "lagrangian": "length",
}
"""Arrays whose numbers or shape nothing but the digest of all arrays protects."""


OTHER_ARRAYS = (
    "rigid-irls full",
    "rigid-diffnea memory",
    "lagrangian memory",
    "lagrangian dissipative",
    "residual on a network",
)
"""Cases whose files hold arrays that the first case of their estimator lacks."""


def spoilt_arrays(values: np.ndarray) -> Iterator[tuple[str, np.ndarray | None]]:
    yield "gone", None
    yield "longer", np.concatenate([values, values]) if values.ndim else None
    yield "empty", values[:0]
    yield "deeper", values[None]
    yield "true or false", values.astype(bool)
    if values.dtype.kind == "f":
        yield "NaN", np.full_like(values, np.nan)
        yield "infinite", np.full_like(values, np.inf)


@pytest.mark.thorough
@pytest.mark.parametrize("case", [*WITH_CASE, *OTHER_ARRAYS])
def test_arrays_missing_misshapen_or_without_numbers_are_refused_or_harmless(case: str) -> None:
    arrays = load(stored(case)[1])
    # Names that differ by more than a number.
    kinds = {"".join(c for c in name if not c.isdigit()): name for name in arrays}
    for kind, name in sorted(kinds.items()):
        if kind in BY_DIGEST_ALONE.get(case.split()[0], "").split():
            continue
        if case == "residual on a network" and not name.startswith("base."):
            continue  # They are those of `residual`.
        for how, values in spoilt_arrays(arrays[name]):
            broken = {k: v for k, v in arrays.items() if k != name}
            if values is not None:
                broken[name] = np.ascontiguousarray(values)
            found = outcome(case, *sealed(case, save(broken)))
            assert is_harmless(case, found), (name, how)


@pytest.mark.thorough
@each_estimator
@pytest.mark.parametrize("to", [None, {}, [], "x", 3])
def test_facts_of_another_kind_are_refused_or_harmless(case: str, to: object) -> None:
    document = json.loads(stored(case)[0])
    # Empty, these stand for the defaults, or for no correction.
    usual = {"filters", "residual", "correction_penalty"} if to in ({}, []) else set()
    for key in document["fitted"].keys() - usual:
        changed = document | {"fitted": document["fitted"] | {key: to}}
        found = outcome(case, json.dumps(changed).encode(), stored(case)[1])
        assert is_harmless(case, found), key


@each_estimator
def test_a_document_that_lacks_a_parameter_is_refused_or_read(case: str) -> None:
    document = json.loads(stored(case)[0])
    for key in document["parameters"]:
        left = {name: value for name, value in document["parameters"].items() if name != key}
        outcome(case, json.dumps(document | {"parameters": left}).encode(), stored(case)[1])


@each_estimator
def test_a_document_with_a_list_cut_short_is_refused_or_read(case: str) -> None:
    document = json.loads(stored(case)[0])
    for section in ("fitted", "parameters"):
        for key, value in document[section].items():
            if isinstance(value, list) and len(value) > 1:
                cut = document[section] | {key: value[:-1]}
                outcome(case, json.dumps(document | {section: cut}).encode(), stored(case)[1])


@pytest.mark.thorough
@each_estimator
@examples(5)
@given(data=st.data())
def test_any_damaged_document_is_refused_or_read(case: str, data: st.DataObject) -> None:
    document = data.draw(damaged([json.loads(stored(case)[0])]))
    outcome(case, json.dumps(document).encode("utf-8", "surrogatepass"), stored(case)[1])


@pytest.mark.thorough
@each_estimator
@examples(5)
@given(data=st.data())
def test_bytes_replaced_in_either_file_are_refused_or_read(case: str, data: st.DataObject) -> None:
    def torn(content: bytes) -> bytes:
        start = data.draw(st.integers(0, len(content)))
        end = data.draw(st.integers(start, min(start + 20, len(content))))
        return content[:start] + data.draw(st.binary(max_size=12)) + content[end:]

    document, arrays = stored(case)
    outcome(case, torn(document), arrays)


# What a fit needs and refuses


@each_estimator
def test_it_states_the_least_that_it_needs(case: str) -> None:
    ((what, least),) = unfitted(case).needs(nominal()).least.items()
    for have in (0, least - 1):
        if what == "samples":
            data = moving(1, samples=have) if have else known(case).take([])
        else:
            data = known(case).take(range(2 * have if what == "poses" else have))
        words = f"{have} {what} are too few: at least {least} are needed"
        if not have and case in ("static-coulomb", "static-hysteresis"):
            words = "do not contain the motion before"
        assert words in refusal(case, data).message


@fits_again
def test_it_states_whether_it_needs_drive_gains(case: str) -> None:
    without = replace(known(case), drive_gains=None)
    if unfitted(case).needs(nominal()).gains:
        error = refusal(case, without)
        assert "drive gains [N·m/A] are unknown" in error.message
        assert "drive_gains_nm_a" in error.hint
    else:
        model = unfitted(case).fit(without, nominal())
        expected = fitted(case).predict(new(case)).effort
        assert model.predict(new(case)).effort == pytest.approx(expected, abs=1e-6)
        assert not model.knows_gains


@fits_others
def test_it_states_which_effort_it_needs_and_keeps_its_unit(case: str) -> None:
    assert "predicts a current, the data contain a torque" in str(
        refused_prediction(case, in_torques(new(case)))
    )
    if unfitted(case).needs(nominal()).effort == "current":
        assert "contain a torque" in refusal(case, in_torques(known(case))).message
        return
    model = unfitted(case).fit(in_torques(known(case)), nominal())
    assert (model.effort_kind_, model.gains_source_) == ("torque", "")
    assert np.array_equal(model.torque_scale_, np.ones(6))
    assert model.knows_gains
    with pytest.raises(DataError, match="predicts a torque, the data contain a current"):
        model.predict(new(case))
    # Networks and penalties see other numbers, and end elsewhere.
    if not case.startswith((*NETWORKS, "static-mlp", "static-linear lasso")):
        found, expected = model.predict(in_torques(new(case))), fitted(case).predict(new(case))
        assert found.effort / GAINS == pytest.approx(expected.effort, abs=1e-6)


def in_torques(data: Dataset) -> Dataset:
    efforts = {name: data[name] * GAINS for name in data.columns if "effort" in name}
    return replace(data.with_columns(**efforts), effort_kind="torque", drive_gains=None)


def refusal(case: str, data: Dataset) -> HilError:
    with pytest.raises((FitError, DataError)) as caught:
        unfitted(case).fit(data, nominal())
    assert caught.value.hint
    return caught.value


def refused_prediction(case: str, data: Dataset) -> DataError:
    with pytest.raises(DataError) as caught:
        fitted(case).predict(data)
    assert caught.value.hint
    return caught.value


def spoilt(data: Dataset, column: str, value: float) -> Dataset:
    """One value replaced: of row 32, in the third joint."""
    values = np.array(data[column])
    values[(31, 2) if values.ndim == 2 else 31] = value
    return data.with_columns(**{column: values})


def of_effort(data: Dataset, change: Callable[[FloatArray], FloatArray]) -> Dataset:
    return data.with_columns(**{n: change(data[n].copy()) for n in data.columns if "effort" in n})


def one_wild_sample(effort: FloatArray) -> FloatArray:
    effort[37, 3] = -1e6
    return effort


def one_gain(value: float) -> Callable[[Dataset], Dataset]:
    return lambda data: replace(data, drive_gains=np.array([*GAINS[:2], value, *GAINS[3:]]))


def of_five_joints(data: Dataset) -> Dataset:
    columns = {n: v if v.ndim == 1 else v[:, :5] for n, v in data.columns.items()}
    arrivals = None if data.arrivals is None else data.arrivals[..., :5]
    return replace(
        data, columns=columns, joint_names=data.joint_names[:5], drive_gains=GAINS[:5],
        arrivals=arrivals,
    )  # fmt: skip


def reversed_joints(data: Dataset) -> Dataset:
    return replace(data, joint_names=data.joint_names[::-1])


WILD = r"wrist_1_joint are impossible: the first, -1e\+06 A in series (trajectory1|dwell3), "
NOT_FINITE = "1 values of {} are not finite, the first in row 32"
REFUSED: Mapping[str, tuple[Callable[[Dataset], Dataset], str]] = {
    **{
        f"{value} in {column}": (
            lambda data, column=column, value=value: spoilt(data, column, value),
            NOT_FINITE.format(column) + (" joint 3" if column != "t" else ""),
        )
        for column, value in (
            ("t", np.nan), ("q", np.nan), ("q", -np.inf), ("effort", np.nan), ("effort", np.inf),
        )
    },
    **{
        f"beyond everything: {column}": (
            lambda data, column=column: spoilt(data, column, 1e300),
            f"^{column} of elbow_joint has the impossible value 1e\\+300 \\(row 32, series ",
        )
        for column in ("q", "qd", "effort")
    },
    "no effort": (lambda data: of_effort(data, np.zeros_like), "0 in every row and joint"),
    "next to no effort": (lambda data: of_effort(data, lambda v: 1e-300 * v), "none was measured"),
    "a wild sample": (lambda data: of_effort(data, one_wild_sample), WILD),
    **{
        f"a gain of {value}": (one_gain(value), "must be finite and above 0, but elbow_joint")
        for value in (0.0, -9.0, np.nan, np.inf)
    },
    "another robot": (lambda data: replace(data, robot="ur10e"), "recorded on a ur10e"),
    "another order": (reversed_joints, "list the joints as wrist_3_joint"),
    "another number": (of_five_joints, "the data have 5 joints, the robot model ur5 has 6"),
}  # fmt: skip


@each_estimator
@pytest.mark.parametrize("kind", REFUSED)
def test_data_that_cannot_be_fitted_are_refused(case: str, kind: str) -> None:
    change, words = REFUSED[kind]
    assert_matches(words, refusal(case, change(known(case))))


def assert_matches(words: str, error: HilError) -> None:
    assert re.search(words, error.message), error.message


@pytest.mark.parametrize("case", IN_MOTION)
@pytest.mark.parametrize("column", ["q_f", "qd_f", "qdd_f", "effort_f"])
def test_columns_that_were_filtered_before_are_looked_at_too(case: str, column: str) -> None:
    for value in (np.nan, 1e300):
        message = refusal(case, spoilt(known(case), column, value)).message
        assert column in message
        assert "not finite" in message or "impossible value" in message


@pytest.mark.parametrize("case", [*IN_MOTION, "static-linear", "static-inverse"])
@pytest.mark.parametrize("stands", [[2], [1, 2, 3, 4]], ids=["one", "several"])
def test_joints_that_never_move_are_named(case: str, stands: list[int]) -> None:
    columns = {
        name: known(case)[name].copy() for name in ("q", "q_f") if name in known(case).columns
    }
    for q in columns.values():
        q[:, stands] = 0.3
    error = refusal(case, known(case).with_columns(**columns))
    assert "elbow_joint" in error.message
    assert "never moved" in error.message


@pytest.mark.thorough
@each_estimator
def test_another_kind_of_series_is_no_data(case: str) -> None:
    if case == "rigid-diffnea":
        pytest.skip("what no motion tells, its nominal arm does")
    other = moving(1, 2) if at_rest(case) else dwelling(60)
    words = "0 (dwells|poses) are too few|motion before the dwells|determine only|left for training"
    assert_matches(f"{words}|too few samples agree|needs a motion", refusal(case, other))


OTHERS: list[tuple[Callable[[Dataset], Dataset], str]] = [
    (lambda d: replace(d, robot="ur10e"), "the model is for a ur5, the data are from a ur10e"),
    (reversed_joints, "the model is for the joints shoulder_pan_joint"),
    (of_five_joints, "the model is for the joints shoulder_pan_joint"),
    (lambda d: replace(d, gravity=(0.0, 0.0, 9.81)), "the model is for gravity"),
]


@each_estimator
def test_data_of_another_robot_are_not_predicted(case: str) -> None:
    for change, words in OTHERS:
        assert_matches(words, refused_prediction(case, change(new(case))))
    nameless = replace(new(case), robot="")
    assert len(fitted(case).predict(nameless).effort) == len(nameless)


@each_estimator
def test_an_estimator_that_is_not_fitted_says_so(case: str, tmp_path: Any) -> None:
    for use in (lambda one: one.predict(new(case)), lambda one: save_model(one, tmp_path)):
        with pytest.raises(FitError, match=f"{case} is not fitted yet"):
            use(unfitted(case))


# Parameters

OF_NO_USE = [
    float("nan"), float("inf"), -1, 10**400, b"x", [[1]], {1: 2}, {"a": 1}, ["x", None], object(),
    1 + 2j, "nowhere",
]  # fmt: skip
"""What no parameter can be."""


@each_estimator
def test_parameters_are_listed_and_unknown_ones_refused(case: str) -> None:
    made = unfitted(case)
    assert tuple(made.get_params()) == made.parameter_names()
    assert estimator(case, **made.get_params()).get_params() == made.get_params()
    slip = made.parameter_names()[0] + "x"
    with pytest.raises(SpecError, match=rf"no parameter '{slip}' \(it has ") as caught:
        estimator(case, **{slip: 1})
    assert made.parameter_names()[0] in caught.value.hint
    with pytest.raises(SpecError, match=f"no parameter '{slip}'"):
        made.set_params(**{slip: 1})


LATER = {"static-mlp-lm": ("device",), "static-hysteresis": ("lengths_rad",)}
"""Parameters that are looked at when a fit needs them, or take bytes for numbers."""


@each_estimator
def test_values_that_cannot_be_are_refused_by_name_and_change_nothing(case: str) -> None:
    made = unfitted(case)
    before = made.get_params()
    for parameter in made.parameter_names():
        for value in OF_NO_USE if parameter not in LATER.get(case, ()) else ():
            with pytest.raises(SpecError, match=rf"^{parameter}\b"):
                kind_of(case)(**{parameter: value})
    assert made.get_params() == before
    with pytest.raises(SpecError, match=rf"^{case}: {made.parameter_names()[-1]}\b"):
        estimator(case, **{made.parameter_names()[-1]: object()})
    with pytest.raises(SpecError, match=rf"^{made.parameter_names()[-1]}\b"):
        made.set_params(**{made.parameter_names()[-1]: object()})
    assert made.get_params() == before
