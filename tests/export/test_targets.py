"""What every export has in common: options, places that cannot be written, damaged models."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from hil.core.errors import DataError, HilError, RecordingError, SpecError
from hil.export.exported import require_new
from hil.export.targets import written_as
from tests.support.json_models import fitted


def damaged(name: str, change):
    model = copy.copy(fitted("rigid-wls"))
    setattr(model, name, change(getattr(model, name)))
    return model


@pytest.mark.parametrize("to", ["c", "json"])
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("coefficients_", lambda value: value * np.nan),
        ("coefficients_", lambda value: value[:-1]),
        ("torque_scale_", lambda value: value[:-1]),
        ("torque_scale_", lambda value: value[:0]),
    ],
)
def test_damaged_models_are_told_as_such(to, name, change, tmp_path) -> None:
    with pytest.raises(HilError):
        written_as(damaged(name, change), tmp_path / "out", to)
    assert not (tmp_path / "out").exists()


def test_it_says_what_is_wrong_with_the_numbers(tmp_path) -> None:
    model = damaged("coefficients_", lambda value: value * np.nan)
    with pytest.raises(DataError, match="nan cannot be a constant"):
        written_as(model, tmp_path / "out", "c", unchecked=True)


def test_an_option_that_is_not_taken_is_as_good_as_none(tmp_path) -> None:
    written_as(fitted("rigid-wls"), tmp_path / "a.json", "json", unchecked=False)
    assert (tmp_path / "a.json").exists()
    with pytest.raises(SpecError, match="no option --unchecked"):
        written_as(fitted("rigid-wls"), tmp_path / "b.json", "json", unchecked=True)


def test_a_link_to_nothing_is_not_written_over(tmp_path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="exists already"):
        require_new(tmp_path / "link")


@pytest.mark.parametrize("to", ["c", "json"])
def test_a_name_that_no_file_can_have_is_told(to, tmp_path) -> None:
    options = {"unchecked": True} if to == "c" else {}
    with pytest.raises(RecordingError, match="cannot write"):
        written_as(fitted("rigid-wls"), tmp_path / ("n" * 300), to, **options)
