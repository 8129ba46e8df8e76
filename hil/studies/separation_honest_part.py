"""The honest protocol, shown: one table of errors, one of what else there is to know."""

from __future__ import annotations

import numpy as np

from hil.estimators import HONEST
from hil.studies.result import Figure, Part, Table
from hil.studies.separation_band import Bands, band_tables
from hil.studies.separation_data import pose_key
from hil.studies.separation_honest import HonestRun
from hil.studies.separation_methods import METHOD_KEYS
from hil.studies.separation_text import joint_titles, listed, mean_of, value, with_mean

BASELINES = {"gravity": "gravity alone", "coulomb": "Fc·sign(approach)"}
OURS = "hysteresis"

APPROACH = ("coulomb", "network-approach", OURS)
"""Methods that know how the arm got to the pose."""

POSE_ONLY = tuple(key for key in METHOD_KEYS if key not in APPROACH)

NOISE = "noise of a dwell's mean"


def honest_part(run: HonestRun, both: Bands | None, figures: tuple[Figure, ...]) -> Part:
    """Everything found under the honest protocol."""
    tables = [_errors(run), _beside(run)]
    if both is not None:
        tables += band_tables(both)
    return Part("Honest", HONEST, tuple(_text(run, both)), tuple(tables), figures)


def honest_summary(run: HonestRun) -> list[str]:
    """What a reader should take away."""
    unit = run.dwells.effort_unit
    errors = {key: mean_of(run.rmse(key)) for key in run.methods}
    known = [f"{words} {errors[key]:.4f}" for key, words in BASELINES.items() if key in errors]
    if OURS not in errors:
        best = min(errors, key=lambda key: errors[key])
        return [f"Honest protocol: best is {run.methods[best].method.words}, "
                f"{errors[best]:.4f} {unit} on poses not seen."]  # fmt: skip
    ours = errors[OURS]
    times = [
        f"{errors[key] / ours:.1f}× below {words}"
        for key, words in BASELINES.items() if key in errors
    ]  # fmt: skip
    text = f"Honest protocol, poses not seen: friction with memory {ours:.4f} {unit}"
    text += f"; {', '.join(known)}" if known else ""
    text += f": {listed(times)}" if times else ""
    return [f"{text}. The noise of a dwell's mean is {mean_of(run.noise):.4f} {unit}."]


def _errors(run: HonestRun) -> Table:
    body = [(one.method.words, *with_mean(run.rmse(key))) for key, one in run.methods.items()]
    body.append((NOISE, *with_mean(run.noise)))
    return Table(
        "table-honest",
        f"Mean effort of each dwell of poses not seen, RMSE [{run.dwells.effort_unit}]",
        ("method", *joint_titles(run.dwells.n_joints), "mean"),
        tuple(body),
        "The last row is what the scatter of the samples leaves in the mean of a dwell: no "
        "method can be better on average, however much it knows.",
    )


def _beside(run: HonestRun) -> Table:
    errors = {key: mean_of(run.rmse(key)) for key in run.methods}
    baselines = [key for key in BASELINES if key in errors]
    body = []
    for key, one in run.methods.items():
        ratios = [errors[base] / errors[key] if errors[key] > 0 else None for base in baselines]
        inside = value(100.0 * mean_of(run.coverage(key)))
        r = value(mean_of(run.correlation(key)))
        body.append((one.method.words, errors[key], *ratios, r, inside, one.seconds, one.chosen))
    return Table(
        "table-honest-more",
        "Beside the error: how many times less than the baselines, R, and how sure a model is",
        ("method", f"RMSE [{run.dwells.effort_unit}]",
         *(f"times below {BASELINES[key]}" for key in baselines),
         "R", "within ±1.96 std [%]", "fit [s]", "chosen by nested validation (folds)"),
        tuple(body),
        "RMSE, R and share are means over the joints. A model that knows how wrong it can be has "
        "95 % of its errors within ±1.96 std. Seconds are of one fit on one core, tuning included.",
    )  # fmt: skip


def _text(run: HonestRun, both: Bands | None) -> list[str]:
    poses = len({pose_key(condition) for condition in run.dwells.conditions})
    how = (
        f"in {run.folds} folds each pose is held out once, both approaches of it together"
        if run.folds > 1
        else f"{len(run.judged_dwells)} dwells of poses drawn at random are held out"
    )
    told = [
        f"What is asked. The mean effort of each single dwell of {poses} poses, from where the "
        f"arm is and how it got there, nothing measured of its effort; {how}. All methods are "
        "fitted to the same dwells and judged on the same. Whatever is tuned, is tuned within the "
        "training poses: when a network stops and its weight decay, how strong a correction is.",
        _pose_only(run),
        _approach(run),
    ]
    if both is not None and len(both.common) and np.any(both.common):
        told.append(
            "Poses approached from both sides need no model to separate the two: the mean of both "
            "dwells is gravity, half their difference is friction. The last tables and figure set "
            "them against what the models predict for poses they have not seen."
        )
    return told


def _pose_only(run: HonestRun) -> str:
    """What methods reach that see the angles and nothing of how the arm got there."""
    errors = {key: mean_of(run.rmse(key)) for key in run.methods if key in POSE_ONLY}
    told = (
        "Why it is harder. At rest, a joint's friction is what its last motion left it with; two "
        "visits to a pose differ by up to twice of it, and no angle tells which one it is."
    )
    if errors:
        low, high = min(errors.values()), max(errors.values())
        told += (
            f" All methods that see the pose and nothing else end up between {low:.4f} and "
            f"{high:.4f} {run.dwells.effort_unit}, whatever their penalty or motor model"
        )
        told += ", the network of the angles among them." if "network" in errors else "."
    return told


def _approach(run: HonestRun) -> str:
    """What the approach and the path into the pose are worth."""
    errors = {key: mean_of(run.rmse(key)) for key in APPROACH if key in run.methods}
    unit = run.dwells.effort_unit
    told = [f"{run.methods[key].method.words} {error:.4f} {unit}" for key, error in errors.items()]
    return (
        "What helps. The side of the approach tells the sign of friction; how far a joint slid "
        "back as it stopped, some tenth of a millirad in the measured positions, tells how much "
        "of it is left. Ours follows that path with a friction state per joint. "
        + (f"With it: {'; '.join(told)}." if told else "No method that uses it was fitted.")
    )
