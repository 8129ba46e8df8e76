"""Tables and texts of a separation study: the recording, the paper's protocol, the honest one.

The paper prints RMSE in amperes (`TABLE_2`, `TABLE_3`, `TABLE_4`); its numbers stand beside ours.
Texts say what is wrong with the paper's protocol and why the honest one is harder, with the numbers
of the run at hand.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.data import correlation, rmse
from hil.estimators import HONEST, PAPER_PROTOCOL, Method
from hil.studies.figure import Figure
from hil.studies.result import (
    Part,
    Table,
    Value,
    joint_titles,
    layout_name,
    listed,
    mean_of,
    value,
    values,
    with_mean,
)
from hil.studies.separation_data import Recording, mean_noise, pose_key, sample_noise
from hil.studies.separation_honest import (
    METHOD_KEYS,
    SHORT,
    Bands,
    HonestRun,
    friction_of,
    gravity_of,
)
from hil.studies.separation_paper import METHODS, Layout, PaperRun


def data_part(recording: Recording, figures: tuple[Figure, ...]) -> Part:
    """What was recorded."""
    dwells = recording.dwells
    poses = len({pose_key(condition) for condition in dwells.conditions})
    text = f"{len(dwells.conditions)} dwells of {poses} poses, {len(dwells)} samples at rest."
    table = Table(
        "table-noise",
        f"Noise of the {dwells.effort_kind} at rest, standard deviation [{dwells.effort_unit}]",
        ("of", *joint_titles(dwells.n_joints), "mean"),
        (
            ("a sample about the mean of its dwell", *with_mean(sample_noise(dwells))),
            ("the mean of a dwell", *with_mean(mean_noise(dwells))),
        ),
        "From the scatter of the samples within their dwell; an error that all samples of a dwell "
        "share does not show in it.",
    )
    return Part("The recording", "", (text,), (table,), figures)


PROTOCOL = f"{PAPER_PROTOCOL}, and samples of every pose are on both sides of the split"


def paper_part(run: PaperRun, figures: tuple[Figure, ...], epochs: int) -> Part:
    """Everything found under the paper's protocol."""
    text = (_what(run, epochs), _target_inside(run), _leak(run), _noise(run), _choice(run))
    return Part("As in the paper", PROTOCOL, text, paper_tables(run, epochs), figures)


def _what(run: PaperRun, epochs: int) -> str:
    return (
        f"What the paper does. Every pose is visited once (from which side is drawn): "
        f"{len(run.data.conditions)} poses, {len(run.data)} samples. The current i of a joint is "
        "regressed on gravity, i²·sign(i) and 1 (eq. 20); what that leaves, networks learn from "
        f"the angles of joints 2 to 5, one per joint, in up to {epochs} epochs. Of all samples "
        "75 % train, 20 % test, and 5 % are set aside. The samples of a dwell differ by noise of "
        "the encoders alone, so the networks see the mean angles of the dwell: its samples then "
        "are one row of more weight, which gives the same network in less time."
    )


def _target_inside(run: PaperRun) -> str:
    return (
        "What is wrong with it, first: the current is predicted from the current. i²·sign(i) is "
        "known only to who has measured i already. Joint 1 shows it: no gravity acts on it, its "
        f"current at rest is friction and nothing else, and yet {100 * run.explained(0):.0f} % of "
        "its variance are “explained”."
    )


def _leak(run: PaperRun) -> str:
    weights, poses = run.networks[run.layout].weights, len(run.data.conditions)
    sample, held_out = mean_of(run.separated().test), mean_of(run.poses_held_out.test)
    dealt = mean_of(run.dealt[0].test)
    return (
        "Second: the test is no test. Three quarters of the samples of each pose are trained on; "
        "the others ask for what has just been seen, and a network of "
        f"{weights} weights has {poses} numbers to remember. The table “What the split hides” "
        f"shows it twice. At poses that are really held out the error is {held_out:.3f} A instead "
        f"of {sample:.4f} A. And with friction dealt out among the poses at random, which nobody "
        f"can predict from the pose, the split by sample still gives {dealt:.4f} A."
    )


NETWORK_A = 0.01
"""The networks of Table 4 reach this at every test but one."""


def _noise(run: PaperRun) -> str:
    of_current, left = mean_of(sample_noise(run.data)), mean_of(run.residual_noise())
    found = {
        "per test sample": run.separated().test,
        "per test sample with the noise taken off": run.beyond_noise(),
        "per dwell, all its samples averaged": run.means_rmse(),
    }
    told = "; ".join(
        f"{words} {mean_of(error):.4f} A ({int(np.sum(error <= NETWORK_A))} of {len(error)} "
        f"joints within {NETWORK_A} A)"
        for words, error in found.items()
    )
    return (
        f"What the numbers can be: one sample carries {of_current:.4f} A of noise (mean over the "
        "joints). The regressor takes up some of it, because it holds the same sample; "
        f"{left:.4f} A are left, and no model of the pose can be better than that per sample. "
        f"The paper's networks reach {NETWORK_A} A; these reach: {told}."
    )


def _choice(run: PaperRun) -> str:
    best = min(run.networks, key=lambda layout: mean_of(run.separated(layout).test))
    return f"By its test error, Table 3 chooses {layout_name(best)}."


WORDS: dict[Method, str] = {
    "ls": "least squares",
    "ridge": "ridge",
    "lasso": "LASSO",
    "elastic-net": "elastic net",
    "wls": "WLS",
}

SUMMARISED: tuple[Method, ...] = ("ls", "wls", "lasso", "elastic-net")


def paper_summary(run: PaperRun) -> list[str]:
    """What a reader should take away."""
    linear = ", ".join(
        f"{WORDS[method]} {mean_of(run.linear_rmse(method, run.partition.test)):.3f}"
        for method in SUMMARISED
    )
    return [
        f"Paper protocol (test RMSE in A, mean over the joints): {linear}; with networks "
        f"{mean_of(run.separated().test):.4f} per sample, {mean_of(run.beyond_noise()):.4f} with "
        f"the noise of single samples taken off.",
        f"The same networks give {mean_of(run.dealt[0].test):.4f} A when friction is dealt out "
        f"among the poses at random, and {mean_of(run.poses_held_out.test):.3f} A at poses that "
        "are really held out: the split by sample measures memory.",
    ]


def paper_tables(run: PaperRun, epochs: int) -> tuple[Table, ...]:
    """All of them."""
    return _table_2(run), _table_3(run, epochs), _table_4(run), _split(run)


def _table_2(run: PaperRun) -> Table:
    return Table(
        "table-2",
        "Table 2: five linear methods on eq. 20, RMSE of the test samples [A]",
        (
            "method",
            *joint_titles(run.data.n_joints),
            "mean",
            "mean, training samples",
            "in the paper",
            "fit [s]",
        ),
        tuple(_linear_row(run, method) for method in METHODS),
        "Fastest of three fits of all joints on one core, standard errors included where the "
        "method has them.",
    )


TABLE_2: dict[Method, float] = {
    "ls": 0.086,
    "ridge": 0.086,
    "lasso": 0.090,
    "elastic-net": 0.094,
    "wls": 0.086,
}


def _linear_row(run: PaperRun, method: Method) -> tuple[Value, ...]:
    test = run.linear_rmse(method, run.partition.test)
    train = mean_of(run.linear_rmse(method, run.partition.train))
    return WORDS[method], *with_mean(test), train, TABLE_2[method], run.linear[method].seconds


def _table_3(run: PaperRun, epochs: int) -> Table:
    return Table(
        "table-3",
        "Table 3: layouts of the networks, RMSE of gravity and friction [A], mean over the joints",
        (
            "layout",
            "hidden layers",
            "weights",
            "train",
            "test",
            "train in the paper",
            "test in the paper",
            "epochs",
            "training [s]",
        ),
        tuple(_layout_row(run, layout) for layout in run.networks),
        f"At most {epochs} epochs of Levenberg–Marquardt; a network is done when no step lowers "
        "its error any more. Epochs are means over the joints, seconds of one core for all of "
        "them. Errors are of single samples: what their noise alone costs is in Table 4.",
    )


TABLE_3: dict[tuple[int, ...], tuple[float, float]] = {
    (4, 20, 10, 10, 1): (0.0337, 0.0314),
    (4, 10, 10, 1): (0.1068, 0.0694),
    (4, 20, 10, 1): (0.0546, 0.0524),
    (4, 15, 10, 1): (0.0610, 0.0586),
    (4, 20, 15, 10, 1): (0.0162, 0.0140),
    (4, 15, 15, 10, 1): (0.0266, 0.0228),
    (4, 10, 10, 10, 1): (0.0550, 0.0521),
    (4, 20, 20, 10, 1): (0.0084, 0.0073),
}
"""By layout: training and test."""


def _layout_row(run: PaperRun, layout: Layout) -> tuple[Value, ...]:
    networks, found = run.networks[layout], run.separated(layout)
    printed: tuple[Value, ...] = TABLE_3.get(layout, (None, None))
    errors = mean_of(found.train), mean_of(found.test)
    training = round(float(networks.epochs.mean())), float(networks.seconds.sum())
    sizes = len(layout) - 2, networks.weights
    return layout_name(layout), *sizes, *errors, *printed, *training


TABLE_4 = (
    (0.009, 0.010),
    (0.009, 0.010),
    (0.003, 0.003),
    (0.008, 0.011),
    (0.006, 0.007),
    (0.007, 0.007),
)
"""By joint: training and test."""

TABLE_4_LAYOUT = (4, 20, 20, 10, 1)


def _table_4(run: PaperRun) -> Table:
    found = run.separated()
    columns = {
        "training samples": found.train,
        "test samples": found.test,
        "noise of a sample": run.residual_noise(),
        "test without noise": run.beyond_noise(),
        "test samples, averaged per dwell": run.means_rmse(run.partition.test),
        "all samples, averaged per dwell": run.means_rmse(),
    }
    n = run.data.n_joints
    printed = np.array(TABLE_4) if n == len(TABLE_4) else np.full((n, 2), np.nan)
    table = np.column_stack([*columns.values(), printed])
    body = [(name, *values(row)) for name, row in zip(joint_titles(n), table, strict=True)]
    body.append(("mean", *values(table.mean(axis=0))))
    return Table(
        "table-4",
        f"Table 4: gravity by WLS and friction by networks {layout_name(run.layout)}, RMSE [A]",
        ("joint", *columns, "train in the paper", "test in the paper"),
        tuple(body),
        "“noise of a sample” is the scatter of what WLS leaves about the mean of its dwell: no "
        "function of the pose gets below it. “test without noise” is √(test² − noise²), about the "
        "error against what the dwell's current is on average. “all samples” holds training "
        f"samples too. The paper's numbers are of networks {layout_name(TABLE_4_LAYOUT)}.",
    )


def _split(run: PaperRun) -> Table:
    rows = {
        "samples held out, as in the paper": run.separated(),
        "whole poses held out": run.poses_held_out,
        "friction dealt out among the poses, samples held out": run.dealt[0],
        "friction dealt out among the poses, whole poses held out": run.dealt[1],
    }
    return Table(
        "table-split",
        f"What the split hides: WLS and networks {layout_name(run.layout)}, test RMSE [A]",
        ("what is held out", *joint_titles(run.data.n_joints), "mean"),
        tuple((words, *with_mean(found.test)) for words, found in rows.items()),
        "Dealt out: what WLS leaves of each dwell is given to another dwell drawn at random, so "
        "that there is nothing about friction to be learned from the pose.",
    )


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


def band_tables(found: Bands) -> tuple[Table, ...]:
    """Gravity and friction band per joint, and how the band grows with the load."""
    return _both(found), _over_load(found)


def _both(found: Bands) -> Table:
    gravity, friction = gravity_of(found), friction_of(found)
    means = [*([gravity] if gravity else []), *friction[-1:]]
    columns = (
        "joint",
        *(f"mean: {SHORT.get(key, 'gravity')}" for key in means),
        "band", "its spread",
        *(f"band: {SHORT[key]}" for key in friction),
        *(f"R: {SHORT[key]}" for key in friction[-1:]),
    )  # fmt: skip
    n = found.common.shape[1]
    body: list[tuple[Value, ...]] = []
    for j, title in enumerate(joint_titles(n)):
        rows = found.common[:, j]
        measured = found.measured.half[rows, j]
        body.append(
            (
                title,
                *(_error(found.measured.mean, found.predicted[k].mean, rows, j) for k in means),
                value(float(np.mean(measured))) if len(measured) else None,
                value(float(np.std(measured))) if len(measured) else None,
                *(_error(found.measured.half, found.predicted[k].half, rows, j) for k in friction),
                *(_r(found, key, rows, j) for key in friction[-1:]),
            )
        )
    return Table(
        "table-sides",
        "Both approaches of a pose: RMSE of their mean, and of half their difference, the band "
        f"[{found.unit}]",
        columns,
        tuple(body),
        f"{len(found.common)} poses. In the mean of both sides stick friction cancels; half their "
        "difference is stick friction, measured without any model. “its spread” is its standard "
        "deviation over the poses: the error of somebody who knows its mean and nothing else.",
    )


def _error(a: FloatArray, b: FloatArray, rows: BoolArray, j: int) -> float | None:
    return value(float(rmse(a[rows, j, None], b[rows, j, None])[0]))


def _r(found: Bands, key: str, rows: BoolArray, j: int) -> float | None:
    a, b = found.measured.half, found.predicted[key].half
    return value(float(correlation(a[rows, j, None], b[rows, j, None])[0]))


def _over_load(found: Bands) -> Table:
    friction = [key for key in friction_of(found) if key != "network-approach"]
    columns = ["joint"]
    for third in ("lightest", "heaviest"):
        columns += [f"load, {third} third", "band"]
        columns += [f"band: {SHORT[key]}" for key in friction]
    body = []
    for j, title in enumerate(joint_titles(found.common.shape[1])):
        rows = np.flatnonzero(found.common[:, j])
        ordered = rows[np.argsort(found.load[rows, j], kind="stable")]
        row: list[Value] = [title]
        for part in (ordered[: len(ordered) // 3], ordered[-(len(ordered) // 3) :]):
            sides = [found.load, found.measured.half]
            sides += [found.predicted[key].half for key in friction]
            row += [value(mean_of(values[part, j])) for values in sides]
        body.append(tuple(row))
    return Table(
        "table-load",
        "Friction band and load: means over the third of the poses with least and with most load "
        f"[{found.unit}]",
        tuple(columns),
        tuple(body),
        "Load is what the drive holds in the mean of both sides. Fc·sign(approach) has one band "
        "for all loads.",
    )
