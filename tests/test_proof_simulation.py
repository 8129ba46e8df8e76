"""Twelve weeks of a robot that wears: seen by the first probe, identified again, promoted once."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from hil.pipeline.simulation import simulate
from hil.report.simulation_found import found
from hil.report.simulation_page import render_simulation
from hil.spec.schedule import load_schedule_spec
from hil_mock_robot.draw import draw_truth

pytestmark = pytest.mark.proof

SCHEDULE = Path(__file__).parents[1] / "experiments" / "reidentify_weekly.yaml"
J2, WEAR = 1, 0.15


@pytest.mark.timeout(1200)
def test_wear_of_one_joint_is_found_and_mended_while_the_room_changes_as_much(
    tmp_path: Path,
) -> None:
    told = simulate(load_schedule_spec(SCHEDULE), timedelta(weeks=12), tmp_path)
    page, what = render_simulation(tmp_path), found(told)
    print(*what.sentences, page.stat().st_size, "bytes of page")  # noqa: T201 - make proof shows it
    assert [one.asked for one in what.criteria if not one.met] == []
    assert len(told["occasions"]) == 13
    assert what.promoted == (0.0, 6.0)
    sixth = told["occasions"][6]["result"]["drift"]
    assert [cause["name"] for cause in sixth["causes"]] == ["shoulder_lift_joint friction"]
    assert sixth["causes"][0]["change"] == pytest.approx(WEAR, abs=0.01)
    # Not more than wear does to what no model of such friction knows.
    assert what.errors[-1][J2] < (1 + WEAR + 0.05) * what.level[J2]
    _require_warmth_of_the_size_of_the_wear(told["warmth"])


def _require_warmth_of_the_size_of_the_wear(warmth: dict) -> None:
    """By the champion's law, which lies between those of the mock's dry and viscous friction."""
    joint = draw_truth("ur5", 0).joints[J2].thermal
    part = warmth["all"]
    cold, warm = part["from_c"][J2], part["to_c"][J2]
    reference = draw_truth("ur5", 0).reference_c

    def law(per_k: float) -> float:
        return (1 + per_k * (warm - reference)) / (1 + per_k * (cold - reference)) - 1

    change = part["friction_change"][J2]
    assert law(joint.viscous_per_k) < change < law(joint.coulomb_per_k)
    assert change < -2 / 3 * WEAR
