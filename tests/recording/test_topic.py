"""Topics: one numpy dtype is the ROS 2 message definition and the CDR layout."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import DataError, RecordingError
from hil.robot.state import Topic, dtype_of_schema, state_topic
from tests.support.recorded_rows import raw_topic, six_axis_topic

TIMES = [("device_time", "<f8"), ("host_time", "<f8")]


def topic_of(*fields: object, **more: object) -> Topic:
    return Topic("/t", np.dtype([*TIMES, *fields]), 100.0, "controller", **more)  # type: ignore[arg-type]


def test_definition_names_every_field_with_type_length_and_unit() -> None:
    lines = six_axis_topic().schema_text.splitlines()
    assert lines[0] == "float64 device_time  # s"
    assert "float64[6] q  # rad" in lines
    assert "float64[6] effort  # A" in lines
    assert lines[-1] == "int32 mode"


ONE_AXIS = state_topic(1, 1.0, clock="controller", effort_unit="A")


@pytest.mark.parametrize("topic", [six_axis_topic(), ONE_AXIS, raw_topic()], ids=lambda t: t.name)
def test_definition_gives_back_the_dtype(topic: Topic) -> None:
    assert dtype_of_schema(topic.schema_text) == topic.dtype


def test_integer_before_a_double_is_refused_with_the_remedy() -> None:
    with pytest.raises(RecordingError, match="'late' at byte 20 is not aligned") as caught:
        topic_of(("early", "<i4"), ("late", "<f8"))
    assert "float64 first" in caught.value.hint


def test_padded_dtype_is_refused() -> None:
    padded = np.dtype([*TIMES, ("small", "|u1"), ("count", "<i4")], align=True)
    with pytest.raises(RecordingError, match="padding bytes before field 'count'"):
        Topic("/t", padded, 100.0, "controller")


@pytest.mark.parametrize("kind", [">f8", "<c16", "<U4", "O", ("<f8", (2, 3))])
def test_field_without_a_fixed_size_ros_type_is_refused(kind: object) -> None:
    field = ("x", *kind) if isinstance(kind, tuple) else ("x", kind)
    with pytest.raises(RecordingError, match="field 'x'"):
        topic_of(field)


def test_record_must_begin_with_both_times() -> None:
    with pytest.raises(RecordingError, match="lacks its times"):
        Topic("/t", np.dtype([("q", "<f8")]), 100.0, "controller")


def test_unit_of_an_unknown_field_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"unknown fields \['qq'\]"):
        topic_of(("q", "<f8"), units={"qq": "rad"})


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_rate_must_be_a_rate(rate_hz: float) -> None:
    with pytest.raises(RecordingError, match="is no rate"):
        Topic("/t", np.dtype(TIMES), rate_hz, "controller")


def test_blank_rows_say_nothing() -> None:
    blank = six_axis_topic().blank(3)
    assert np.isnan(blank["q"]).all()
    assert np.isnan(blank["device_time"]).all()
    assert (blank["status"] == 0).all()


@pytest.mark.parametrize(
    "definition",
    ["string name", "float64[] q", "float64[<=6] q", "geometry_msgs/Pose pose", "float64[0] q"],
)
def test_definition_of_varying_size_is_refused(definition: str) -> None:
    with pytest.raises(DataError):
        dtype_of_schema(f"float64 t\n{definition}\n")
