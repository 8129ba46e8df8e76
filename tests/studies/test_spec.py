"""What a spec may ask of studies, and what is said when it asks for something else."""

from __future__ import annotations

import pytest

from hil.core.errors import SpecError
from hil.spec import spec_from_text, spec_hash
from tests.support.study_parts import Counted, register

BEFORE = "0b571600153e60c56f2d133d444b72d4256564e20fe1301a9d3c7e1cd93367be"
GOOD = "hil: 1\nname: demo\nrobot: ur5\nexcitation: {kind: dwell}\n"


class OfTrajectories(Counted):
    """A study that needs trajectories."""

    series_kinds = (("trajectory",),)


@pytest.fixture(autouse=True)
def _studies(monkeypatch: pytest.MonkeyPatch) -> None:
    of = "tests.studies.test_spec:OfTrajectories"
    register(
        monkeypatch,
        counted="tests.support.study_parts:Counted",
        moving=of,
        broken="no_such_module:Thing",
    )


def line_of(text: str) -> str:
    with pytest.raises(SpecError) as caught:
        spec_from_text(GOOD + text, "f")
    return caught.value.message


def test_the_keys_beside_the_name_are_its_parameters() -> None:
    (entry,) = spec_from_text(GOOD + "study: [{study: counted, rounds: 5}]").study
    assert (entry.study, entry.parameters) == ("counted", {"rounds": 5})


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("study: cuonted", "f:5:17: study.0.study: there is no study 'cuonted'; did you mean"),
        ("rounds: 2", "f:5:9: study.0.study: is missing"),
        ("study: counted, round: 2", "f:5:26: study.0.round: counted has no parameter 'round'"),
        ("study: counted, rounds: 0", "f:5:34: study.0.rounds: rounds is 0, but must be at"),
        ("study: broken", "f:5:17: study.0.study: the study 'broken' (no_such_module:Thing) does"),
        ("study: moving", "f:5:17: study.0.study: moving cannot use the dwells"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(entry: str, expected: str) -> None:
    assert line_of(f"study: [{{{entry}}}]").startswith(expected)


def test_without_any_installed_the_message_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.core.plugins.entry_points", lambda *, group: [])
    assert "there is no study 'counted'; none is installed" in line_of("study: [{study: counted}]")


def test_a_spec_without_studies_keeps_the_hash_it_had_before_there_were_any() -> None:
    """Computed by the code before there were studies: runs begun with it can go on."""
    assert spec_hash(spec_from_text(GOOD)) == spec_hash(spec_from_text(GOOD + "study: []"))
    assert spec_hash(spec_from_text(GOOD)) == BEFORE


def test_the_interlock_on_the_speed_slider_changes_the_hash_only_where_it_is_changed() -> None:
    listed = "interlocks: [{kind: speed_scaling}]"
    stops = "interlocks: [{kind: speed_scaling, action: stop}]"
    assert spec_hash(spec_from_text(GOOD + listed)) == BEFORE
    assert spec_hash(spec_from_text(GOOD + stops)) != BEFORE


def test_a_study_is_part_of_what_a_spec_says() -> None:
    asked = spec_from_text(GOOD + "study: [{study: counted}]")
    other = spec_from_text(GOOD + "study: [{study: counted, rounds: 2}]")
    assert len({spec_hash(spec) for spec in (asked, other, spec_from_text(GOOD))}) == 3
