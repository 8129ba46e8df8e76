"""Tables and texts of the separation study: data, protocol of the static paper, honest protocol.

The static paper prints RMSE in amperes (`TABLE_2`, `TABLE_3`, `TABLE_4`); the tables of the study
show the printed values beside the computed values. The texts explain the weaknesses of the protocol
of the static paper and the difficulty of the honest protocol, with the numbers of the evaluated
run.
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
    """Return the part of the result that describes the recorded data."""
    dwells = recording.dwells
    poses = len({pose_key(condition) for condition in dwells.conditions})
    text = f"{len(dwells.conditions)} dwells at {poses} poses, {len(dwells)} static samples."
    table = Table(
        "table-noise",
        f"Noise of the {dwells.effort_kind} in dwells, standard deviation [{dwells.effort_unit}]",
        ("noise of", *joint_titles(dwells.n_joints), "mean"),
        (
            ("a sample about the mean of its dwell", *with_mean(sample_noise(dwells))),
            ("the mean of a dwell", *with_mean(mean_noise(dwells))),
        ),
        "Computed from the scatter of the samples within their dwell; errors common to all samples "
        "of a dwell are not included.",
    )
    return Part("The recording", "", (text,), (table,), figures)


PROTOCOL = f"{PAPER_PROTOCOL}, and samples of every pose are on both sides of the split"


def paper_part(run: PaperRun, figures: tuple[Figure, ...], epochs: int) -> Part:
    """Return the part of the result with the tables and figures under the static-paper protocol."""
    text = (_what(run, epochs), _target_inside(run), _leak(run), _noise(run), _choice(run))
    return Part("As in the paper", PROTOCOL, text, paper_tables(run, epochs), figures)


def _what(run: PaperRun, epochs: int) -> str:
    return (
        f"Method of the paper. Every pose is visited once (approach direction drawn at random): "
        f"{len(run.data.conditions)} poses, {len(run.data)} samples. The current i of a joint is "
        "regressed on gravity, i²·sign(i) and 1 (eq. 20). One network per joint learns the "
        f"residual from the angles of joints 2 to 5, in up to {epochs} epochs. Of all samples, "
        "75 % are for training, 20 % for testing, and 5 % are set aside. The angles of a dwell "
        "differ by encoder noise only. The networks therefore use the mean angles of each dwell: "
        "its samples become one row with a higher weight, which yields the same network in less "
        "time."
    )


def _target_inside(run: PaperRun) -> str:
    return (
        "First problem: the current is predicted from the current, because i²·sign(i) is known "
        "only if i has been measured. Joint 1 shows this: it carries no gravity load, so that its "
        f"static current is friction only, but {100 * run.explained(0):.0f} % of its variance are "
        "“explained”."
    )


def _leak(run: PaperRun) -> str:
    weights, poses = run.networks[run.layout].weights, len(run.data.conditions)
    sample, held_out = mean_of(run.separated().test), mean_of(run.poses_held_out.test)
    dealt = mean_of(run.dealt[0].test)
    return (
        "Second problem: training and test samples are not independent. Three quarters of the "
        "samples of each pose are training samples, and a network with "
        f"{weights} weights has to memorise only {poses} values. The table “Effect of the split” "
        f"shows this twice. At held-out poses, the error is {held_out:.3f} A instead of "
        f"{sample:.4f} A. With friction values permuted at random among the poses, which cannot be "
        f"predicted from the pose, the split by sample still yields {dealt:.4f} A."
    )


NETWORK_A = 0.01
"""RMSE [A] that the networks of Table 4 achieve in all tests except one."""


def _noise(run: PaperRun) -> str:
    of_current, left = mean_of(sample_noise(run.data)), mean_of(run.residual_noise())
    found = {
        "per test sample": run.separated().test,
        "per test sample without its noise": run.beyond_noise(),
        "per dwell, mean of all its samples": run.means_rmse(),
    }
    told = "; ".join(
        f"{words} {mean_of(error):.4f} A ({int(np.sum(error <= NETWORK_A))} of {len(error)} "
        f"joints within {NETWORK_A} A)"
        for words, error in found.items()
    )
    return (
        f"Lower bound of the errors: one sample has {of_current:.4f} A of noise (mean over the "
        "joints). The regression explains a part of it, because the regressor contains the same "
        f"sample; {left:.4f} A remain, and no model of the pose can reach a smaller error per "
        f"sample. The networks of the paper reach {NETWORK_A} A; the networks here reach: {told}."
    )


def _choice(run: PaperRun) -> str:
    best = min(run.networks, key=lambda layout: mean_of(run.separated(layout).test))
    return f"The layout with the smallest test error in Table 3 is {layout_name(best)}."


WORDS: dict[Method, str] = {
    "ls": "least squares",
    "ridge": "ridge",
    "lasso": "LASSO",
    "elastic-net": "elastic net",
    "wls": "WLS",
}

SUMMARISED: tuple[Method, ...] = ("ls", "wls", "lasso", "elastic-net")


def paper_summary(run: PaperRun) -> list[str]:
    """Return the main conclusions under the protocol of the static paper."""
    linear = ", ".join(
        f"{WORDS[method]} {mean_of(run.linear_rmse(method, run.partition.test)):.3f}"
        for method in SUMMARISED
    )
    return [
        f"Paper protocol (test RMSE in A, mean over the joints): {linear}; with networks "
        f"{mean_of(run.separated().test):.4f} per sample, {mean_of(run.beyond_noise()):.4f} "
        f"without the noise of single samples.",
        f"The same networks have an error of {mean_of(run.dealt[0].test):.4f} A if the friction is "
        f"permuted at random among the poses, and of {mean_of(run.poses_held_out.test):.3f} A at "
        "held-out poses: the split by sample measures how well they memorise.",
    ]


def paper_tables(run: PaperRun, epochs: int) -> tuple[Table, ...]:
    """Return all tables under the protocol of the static paper."""
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
        "Fit time: fastest of three fits of all joints on one core, including standard errors if "
        "the method has them.",
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
        f"At most {epochs} epochs of Levenberg–Marquardt; a training ends earlier if no step "
        "reduces the error. Epochs: mean over the joints. Training: time on one core for all "
        "joints. Errors refer to single samples; Table 4 shows the share of their noise.",
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
"""Training and test RMSE [A] as printed in the static paper, by network layout."""


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
"""Training and test RMSE [A] as printed in the static paper, by joint."""

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
        "“noise of a sample” is the scatter of the WLS residuals about the mean of their dwell: no "
        "function of the pose has a smaller error. “test without noise” is √(test² − noise²), "
        "approximately the error relative to the mean current of the dwell. “all samples” includes "
        "training samples. The numbers of the paper are for networks "
        f"{layout_name(TABLE_4_LAYOUT)}.",
    )


def _split(run: PaperRun) -> Table:
    rows = {
        "samples held out, as in the paper": run.separated(),
        "whole poses held out": run.poses_held_out,
        "friction permuted among the poses, samples held out": run.dealt[0],
        "friction permuted among the poses, whole poses held out": run.dealt[1],
    }
    return Table(
        "table-split",
        f"Effect of the split: WLS and networks {layout_name(run.layout)}, test RMSE [A]",
        ("held out", *joint_titles(run.data.n_joints), "mean"),
        tuple((words, *with_mean(found.test)) for words, found in rows.items()),
        "Permuted: the WLS residuals of each dwell are assigned to a different dwell at random, so "
        "that friction cannot be predicted from the pose.",
    )


BASELINES = {"gravity": "gravity alone", "coulomb": "Fc·sign(approach)"}
OURS = "hysteresis"

APPROACH = ("coulomb", "network-approach", OURS)
"""Keys of the methods that use the approach direction of a pose."""

POSE_ONLY = tuple(key for key in METHOD_KEYS if key not in APPROACH)
NOISE = "noise of the mean of a dwell"


def honest_part(run: HonestRun, both: Bands | None, figures: tuple[Figure, ...]) -> Part:
    """Return the part of the result with the tables and figures under the honest protocol."""
    tables = [_errors(run), _beside(run)]
    if both is not None:
        tables += band_tables(both)
    return Part("Honest", HONEST, tuple(_text(run, both)), tuple(tables), figures)


def _errors(run: HonestRun) -> Table:
    body = [(one.method.words, *with_mean(run.rmse(key))) for key, one in run.methods.items()]
    body.append((NOISE, *with_mean(run.noise)))
    return Table(
        "table-honest",
        f"Mean effort of each dwell at held-out poses, RMSE [{run.dwells.effort_unit}]",
        ("method", *joint_titles(run.dwells.n_joints), "mean"),
        tuple(body),
        "The last row is the standard deviation of the mean of a dwell due to the scatter of its "
        "samples: no method can have a smaller error on average.",
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
        "Improvement over the baselines, R, and predicted uncertainty",
        ("method", f"RMSE [{run.dwells.effort_unit}]",
         *(f"{BASELINES[key]} / method" for key in baselines),
         "R", "within ±1.96 std [%]", "fit [s]", "chosen by nested validation (folds)"),
        tuple(body),
        "RMSE, R and share are means over the joints. “baseline / method” is the ratio of the "
        "errors. With a correct predicted uncertainty, 95 % of the errors are within ±1.96 std. "
        "Fit time: one fit on one core, including tuning.",
    )  # fmt: skip


def _text(run: HonestRun, both: Bands | None) -> list[str]:
    poses = len({pose_key(condition) for condition in run.dwells.conditions})
    how = (
        f"each pose is held out in one of {run.folds} folds, together with both its approaches"
        if run.folds > 1
        else f"{len(run.judged_dwells)} dwells of poses drawn at random are held out"
    )
    told = [
        f"Task: predict the mean effort of each dwell at {poses} poses from the pose and the "
        f"motion into the pose, without any measured effort; {how}. All methods are fitted to the "
        "same dwells and evaluated on the same dwells. Settings are tuned within the training "
        "poses: early stopping and weight decay of networks, strength of corrections.",
        _pose_only(run),
        _approach(run),
    ]
    if both is not None and len(both.common) and np.any(both.common):
        told.append(
            "At poses approached from both directions, gravity and friction can be separated "
            "without a model: the mean of both dwells is gravity, half their difference is "
            "friction. The last tables and the last figure compare both with the predictions of "
            "the models for held-out poses."
        )
    return told


def _pose_only(run: HonestRun) -> str:
    """Return the text about methods that use joint angles but not the approach direction."""
    errors = {key: mean_of(run.rmse(key)) for key in run.methods if key in POSE_ONLY}
    told = (
        "Difficulty: the static friction of a joint depends on its last motion. Two visits to the "
        "same pose differ by up to twice the friction, and the joint angles do not determine which "
        "value applies."
    )
    if errors:
        low, high = min(errors.values()), max(errors.values())
        told += (
            f" All methods that use only the pose have errors between {low:.4f} and "
            f"{high:.4f} {run.dwells.effort_unit}, independent of penalty and motor model"
        )
        told += ", including the network of the angles." if "network" in errors else "."
    return told


def _approach(run: HonestRun) -> str:
    """Return the text about the benefit of the approach direction and of the path to the pose."""
    errors = {key: mean_of(run.rmse(key)) for key in APPROACH if key in run.methods}
    unit = run.dwells.effort_unit
    told = [f"{run.methods[key].method.words} {error:.4f} {unit}" for key, error in errors.items()]
    return (
        "Solution: the approach direction determines the sign of the friction. The distance that a "
        "joint slides back as it stops, some tenths of a millirad in the measured positions, "
        "determines the remaining friction. Our method follows this path with a friction state per "
        "joint. "
        + (
            f"Errors with the approach direction: {'; '.join(told)}."
            if told
            else "No method that uses the approach direction was fitted."
        )
    )


def honest_summary(run: HonestRun) -> list[str]:
    """Return the main conclusions under the honest protocol."""
    unit = run.dwells.effort_unit
    errors = {key: mean_of(run.rmse(key)) for key in run.methods}
    known = [f"{words} {errors[key]:.4f}" for key, words in BASELINES.items() if key in errors]
    if OURS not in errors:
        best = min(errors, key=lambda key: errors[key])
        return [f"Honest protocol: best is {run.methods[best].method.words}, "
                f"{errors[best]:.4f} {unit} at held-out poses."]  # fmt: skip
    ours = errors[OURS]
    times = [
        f"{errors[key] / ours:.1f}× below {words}"
        for key, words in BASELINES.items() if key in errors
    ]  # fmt: skip
    text = f"Honest protocol, held-out poses: friction with memory {ours:.4f} {unit}"
    text += f"; {', '.join(known)}" if known else ""
    text += f": {listed(times)}" if times else ""
    return [f"{text}. The noise of the mean of a dwell is {mean_of(run.noise):.4f} {unit}."]


def band_tables(found: Bands) -> tuple[Table, ...]:
    """Return tables of gravity and friction band per joint, and of the band over the load."""
    return _both(found), _over_load(found)


def _both(found: Bands) -> Table:
    gravity, friction = gravity_of(found), friction_of(found)
    means = [*([gravity] if gravity else []), *friction[-1:]]
    columns = (
        "joint",
        *(f"mean: {SHORT.get(key, 'gravity')}" for key in means),
        "band", "spread of the band",
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
        "Both approaches of a pose: RMSE of their mean (gravity) and of half their difference "
        f"(band) [{found.unit}]",
        columns,
        tuple(body),
        f"{len(found.common)} poses. Static friction cancels in the mean of both approaches; half "
        "their difference is the static friction, measured without a model. “spread of the band” "
        "is its standard deviation over the poses: the error of a constant prediction of its mean.",
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
        "Friction band and load: means over the third of the poses with the smallest and with the "
        f"largest load [{found.unit}]",
        tuple(columns),
        tuple(body),
        "Load: effort of the drive, mean of both approaches. Fc·sign(approach) has one band for "
        "all loads.",
    )
