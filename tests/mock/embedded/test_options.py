"""What a station may say about the mock's clock, journal and faults."""

import re

import pytest

from hil.core.errors import SpecError
from hil_mock_robot.embedded.faults import EmbeddedFault
from hil_mock_robot.embedded.options import Options
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.paths import DOCS

PAGE = DOCS / "reference" / "mock.md"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"clock": "real"}, "clock is 'real'"),
        ({"clock": "wall", "speed": 50}, "speed is 50"),
        ({"clock": "wall", "speed": True}, "speed is True"),
        ({"clock": "wall", "watchdog_s": -1}, "watchdog_s is -1"),
        ({"clock": "wall", "queue_s": "long"}, "queue_s is 'long'"),
        ({"clock": "wall", "rate_hz": 50, "speed": 0.1}, "makes 5 samples per second"),
        ({"clock": "wall", "block": 16}, "block means nothing with clock: wall"),
        ({"speed": 2.0}, "speed means nothing with clock: virtual"),
        ({"watchdog_s": 1.0}, "watchdog_s means nothing"),
        ({"journal": 5}, "journal is 5"),
        ({"faults": "freeze"}, "faults is 'freeze'"),
        ({"faults": {"kind": "freeze", "at_s": 1}}, "faults is"),
        ({"faults": ["freeze"]}, r"faults\[0\] is 'freeze'"),
        ({"faults": [{"kind": "melt", "at_s": 1}]}, r"faults\[0\] is .*melt"),
        ({"faults": [{"kind": "nan", "at_s": 1}, {"kind": "freeze"}]}, r"faults\[1\] is"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "segment": 1}]}, r"\(freeze\) is"),
        (
            {"faults": [{"kind": "freeze", "at_s": "soon"}]},
            r"mock option faults\[0\] \(freeze\)\.at_s is 'soon'",
        ),
        ({"faults": [{"kind": "freeze", "at_s": -1}]}, r"\.at_s is -1"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "by_s": 1}]}, r"\(freeze\) has no key by_s"),
        ({"faults": [{"kind": "freeze", "at_s": 1, "after_s": 1}]}, r"after_s is 1"),
        ({"faults": [{"kind": "lag", "at_s": 1}]}, r"\(lag\) lacks by_s"),
        ({"faults": [{"kind": "drop", "at_s": 1, "samples": 0}]}, r"samples is 0"),
        ({"faults": [{"kind": "drop", "segment": 1.5}]}, r"segment is 1\.5"),
        ({"faults": [{"kind": "freeze", "at_s": float("nan")}]}, r"at_s is nan"),
    ],
)
def test_an_option_that_cannot_be_is_named(options, said):
    with pytest.raises(SpecError, match=said) as error:
        MockRobot("bench", **options)
    assert error.value.hint


def test_faults_are_read_as_they_stand_in_a_station():
    given = [
        {"kind": "protective_stop", "at_s": 2},
        {"kind": "lag", "segment": 3, "after_s": 0.5, "by_s": 0.2, "for_s": 1},
        {"kind": "clock_jump", "at_s": 1.0, "by_s": -3.0},
    ]
    stop, lag, jump = EmbeddedFault.all_of(given)
    assert (stop.kind, stop.at_s, stop.segment) == ("protective_stop", 2.0, None)
    assert (lag.segment, lag.after_s, lag.by_s, lag.for_s) == (3, 0.5, 0.2, 1.0)
    assert (jump.at_s, jump.by_s) == (1.0, -3.0)


def test_the_clock_is_virtual_unless_the_station_says_wall():
    assert MockRobot("bench").capabilities.clock == "virtual"
    assert MockRobot("bench", clock="wall").capabilities.clock == "wall"


def test_the_reference_has_a_row_for_every_option_and_every_kind_of_fault():
    rows = re.findall(r"^\| `(\w+)` \|", PAGE.read_text("utf-8"), re.MULTILINE)
    assert rows[: len(Options.__dataclass_fields__)] == list(Options.__dataclass_fields__)
    assert set(EmbeddedFault.kinds) <= set(rows)
