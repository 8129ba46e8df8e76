"""Tables and verdicts of the networks' benchmark."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.identification import networks_mock as mock
from benchmarks.identification.networks_mock import Contest
from benchmarks.identification.networks_ur10e import PRODUCT, Score
from benchmarks.identification.table import Section, Table, joints, numbers, slug
from benchmarks.identification.ur10e import GOAL_FILTERED_A
from hil.studies.inverse_methods import ROWS

BELOW, CLOSED, RC_BELOW = 0.55, 0.60, 0.25
"""Goals: ours below the best of Methods 1 to 6, of the gap to the oracle, and RC below Proposed."""


def told_of_robots(contests: Sequence[Contest]) -> Section:
    """Mock robots: errors of every method, goals, parts beside the truth, residual networks."""
    section = Section()
    for contest in contests:
        section.tables.append(_errors(contest, section))
    section.tables.append(_goals(contests, section))
    section.tables.append(_parts(contests, section))
    rows = [
        (f"seed {one.seed}", key, told.decided) for one in contests
        for key, told in one.told.items()
    ]  # fmt: skip
    section.tables.append(_decisions("Mock robots", "A", rows))
    return section


def told_of_ur10e(scores: dict[str, list[Score]]) -> Section:
    """Report mean and spread of every method over the seeds for the UR10e."""
    section = Section()
    count = max(len(found) for found in scores.values())
    n = len(next(iter(scores.values()))[0].raw)
    table = Table(
        f"UR10e, four trajectories → 14h50: RMSE [A], mean and standard deviation of {count} seeds",
        ("method", "raw", "filtered", *joints(n), "CPU s"),
        notes=["joints: filtered"],
    )
    for key, found in scores.items():
        _row(key, [one for one in found if not one.failed], table, section)
        _failed(f"UR10e, {ROWS[key].words}", [one.failed for one in found], section)
    noise = next((one.noise for found in scores.values() for one in found if not one.failed), None)
    if noise is not None:
        table.add("noise (raw less filtered)", f"{np.mean(noise):.4f}", "", numbers(noise), "")
    seeds = [
        (f"draw {i + 1}", key, one.decided)
        for key, found in scores.items()
        for i, one in enumerate(found)
    ]
    section.tables += [table, _decisions("UR10e", "A", seeds)]
    if PRODUCT in scores:
        worst = max(float(np.mean(one.filtered)) for one in scores[PRODUCT])
        section.ratios["ur10e_ours_residual_filtered_to_goal"] = worst / GOAL_FILTERED_A
    return section


def _errors(contest: Contest, section: Section) -> Table:
    table = Table(
        f"Mock {mock.ARM}, seed {contest.seed}: RMSE [N·m] on held-out trajectories, filtered",
        ("method", *joints(len(contest.noise)), "mean", "raw", "within 90 %", "CPU s"),
        notes=["within: measured torques inside the 90 % bands the model tells of itself"],
    )
    for key, told in contest.told.items():
        found, where = told.judged, slug(f"seed{contest.seed}", key)
        _failed(f"seed {contest.seed}, {ROWS[key].words}", [found.failed], section)
        raw, within = float(np.mean(found.raw)), float(np.mean(found.within))
        mean = contest.error(key)
        ends = (f"{mean:.4f}", f"{raw:.4f}", f"{within:.0f} %", f"{found.seconds:.0f}")
        table.add(key, numbers(found.filtered), *ends)
        section.figures |= {f"{where}_rmse_nm": mean, f"{where}_raw_rmse_nm": raw}
        section.figures[f"{where}_cpu_s"] = found.seconds
    raw_noise = f"{np.mean(contest.raw_noise):.4f}"
    table.add("oracle", numbers(contest.noise), f"{contest.oracle:.4f}", raw_noise, "", "")
    section.figures[f"seed{contest.seed}_oracle_rmse_nm"] = contest.oracle
    return table


def _goals(contests: Sequence[Contest], section: Section) -> Table:
    table = Table(
        f"Goals: below the best of Methods 1 to 6 by {BELOW:.0%}, {CLOSED:.0%} of the gap to the "
        f"oracle closed, RC below Proposed by {RC_BELOW:.0%}",
        ("seed", "best of 1-6", "ours below", "gap", "residual below", "gap", "RC below"),
    )
    worst: dict[str, list[float]] = {}
    for one in contests:
        rc = one.error(mock.CORRECTED) / one.error(mock.PROPOSED)
        left: list[float] = []
        for key in (mock.OURS, mock.PRODUCT):
            left += [one.left(key), one.gap_left(key)]
            if key in one.told:
                name = slug(key)
                worst.setdefault(f"{name}_error_to_goal", []).append(left[-2] / (1.0 - BELOW))
                worst.setdefault(f"{name}_gap_left_to_goal", []).append(left[-1] / (1.0 - CLOSED))
        if {mock.CORRECTED, mock.PROPOSED} <= one.told.keys():
            worst.setdefault("rc_error_to_goal", []).append(rc / (1.0 - RC_BELOW))
        shares = [1.0 - value for value in (*left, rc)]
        table.add(str(one.seed), f"{one.best} {one.error(one.best):.3f}", map(_percent, shares))
        names = ("ours_below", "ours_gap", "residual_below", "residual_gap", "rc_below")
        for name, share in zip(names, shares, strict=True):
            if np.isfinite(share):
                section.figures[f"seed{one.seed}_{name}"] = share
    section.ratios |= {f"worst_{name}": _worst(values) for name, values in worst.items()}
    return table


def _worst(ratios: Sequence[float]) -> float:
    """Return the largest value; infinite if a requested method failed on any robot."""
    return max(ratio if np.isfinite(ratio) else np.inf for ratio in ratios)


def _parts(contests: Sequence[Contest], section: Section) -> Table:
    table = Table(
        "Parts beside the truth: error of M(q) over M(q), RMSE of gravity and friction [N·m]",
        ("seed", "method", "M(q)", "gravity", "friction", "gravity, joints 1 to 6"),
        notes=["means over the judged rows are removed from gravity and friction: no total torque "
               "tells a constant of one from a constant of the other"],
    )  # fmt: skip
    for one in contests:
        for key, told in one.told.items():
            parts = told.parts
            if parts is None:
                continue
            gravity, friction = float(np.mean(parts.gravity)), float(np.mean(parts.friction))
            ends = (f"{gravity:.3f}", f"{friction:.3f}", " ".join(numbers(parts.gravity, ".2f")))
            table.add(str(one.seed), key, _percent(parts.mass), *ends)
            where = slug(f"seed{one.seed}", key)
            section.figures[f"{where}_mass_error"] = parts.mass
            section.figures |= {f"{where}_gravity_nm": gravity, f"{where}_friction_nm": friction}
    return table


def _row(key: str, found: Sequence[Score], table: Table, section: Section) -> None:
    if not found:
        return
    raw, filtered = (
        np.array([np.mean(getattr(one, kind)) for one in found]) for kind in ("raw", "filtered")
    )
    each = np.mean([one.filtered for one in found], axis=0)
    seconds = float(np.mean([one.seconds for one in found]))
    table.add(key, _spread(raw), _spread(filtered), numbers(each), f"{seconds:.0f}")
    name = slug("ur10e", key)
    section.figures |= {
        f"{name}_raw_a": float(np.mean(raw)),
        f"{name}_filtered_a": float(np.mean(filtered)),
        f"{name}_filtered_spread_a": float(np.std(filtered, ddof=1)) if len(found) > 1 else 0.0,
    }


def _decisions(of: str, unit: str, rows: Sequence[tuple[str, str, str]]) -> Table:
    return Table(
        f"{of}: residual networks, joint by joint; error without → with on trajectories left out",
        ("", "method", f"decision ({unit})"),
        [row for row in rows if row[2]],
    )


def _failed(what: str, reasons: Sequence[str], section: Section) -> None:
    told = [reason for reason in reasons if reason]
    if told:
        section.skipped[what] = told[0].partition("\n")[0]


def _spread(values: Sequence[float] | np.ndarray) -> str:
    more = f" ± {np.std(values, ddof=1):.4f}" if len(values) > 1 else ""
    return f"{np.mean(values):.4f}{more}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if np.isfinite(share) else ""
