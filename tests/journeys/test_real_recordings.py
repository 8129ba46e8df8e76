"""Recorded robots: imports of every shipped layout, and the published-data baselines."""

import os
from pathlib import Path

import numpy as np
import pytest

import hil
from hil.core.errors import DataError
from hil.data.splits import split
from hil.dynamics import load_model
from hil.estimators.rigid_linear import RigidWls
from hil.evaluation import evaluate
from hil.importers import import_recording
from hil.importers.sources import load_source
from tests.support.paths import EXPERIMENTS, ROOT

DATA = Path(os.environ.get("HIL_DATA", ROOT.parent / "shared" / "data"))
MAPS = EXPERIMENTS / "maps"

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not (DATA / "ur10e").is_dir(),
        reason="the recorded robot data are not here: set HIL_DATA to their folder",
    ),
]

TRAIN = {
    "ur-20_02_10-30sec_12harm": (635, 3510),
    "ur-20_02_12-40sec_12harm": (500, 4460),
    "ur-20_02_12-50sec_12harm": (355, 5090),
    "ur-20_02_05-20sec_8harm": (320, 2310),
}
VALIDATION = {"ur-20_02_19_14harm50sec": (195, 4966)}


@pytest.fixture(scope="module")
def ur10e(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ur10e")

    def imported(windows):
        for name, rows in windows.items():
            out = folder / f"{name}.mcap"
            import_recording(
                DATA / "ur10e" / f"{name}.csv",
                map_file=MAPS / "ur10e_columns.yaml",
                out=out,
                rows=rows,
            )
            yield out

    return list(imported(TRAIN)), list(imported(VALIDATION))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("parameters", "sources", "raw", "filtered"),
    [
        ({}, 4, 0.1450, 0.1145),
        ({"weighted": False}, 4, 0.1470, None),
        ({}, 1, 0.1485, None),
        ({"sign_width": 0.0}, 1, 0.1642, None),
        ({"sign_width": 0.0, "weighted": False}, 1, 0.1746, None),
    ],
    ids=["wls", "ols", "one-file", "hard-sign", "hard-sign-ols"],
)
def test_ur10e_baselines_are_reproduced(
    ur10e, tmp_path, parameters, sources, raw, filtered
) -> None:
    train, validation = ur10e
    report = hil.fit(
        train[:sources],
        estimator="rigid-wls",
        robot="ur10e",
        validate=validation,
        out=tmp_path,
        parameters=parameters,
    ).to_dict()
    (entry,) = report["validation"]
    assert entry["mean_raw"] == pytest.approx(raw, rel=0.005)
    if filtered is not None:
        assert entry["mean_filtered"] == pytest.approx(filtered, rel=0.005)
        assert entry["rmse_raw"] == pytest.approx([0.234, 0.327, 0.172, 0.045, 0.052, 0.040], 0.02)
        assert entry["noise_floor"] == pytest.approx(
            [0.150, 0.180, 0.112, 0.026, 0.038, 0.028], abs=6e-4
        )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("estimator", "parameters", "raw"),
    [
        ("rigid-linear", {"method": "ols"}, 0.1470),
        ("rigid-linear", {"method": "wls"}, 0.1450),
        ("rigid-irls", {"exponent": False, "feasible": False}, 0.1451),
        ("rigid-lmi", {"weighted": True}, 0.1448),
    ],
    ids=["ols", "wls", "irls", "lmi"],
)
def test_ur10e_classical_methods_are_reproduced(
    ur10e, tmp_path, estimator, parameters, raw
) -> None:
    train, validation = ur10e
    (entry,) = hil.fit(
        train,
        estimator=estimator,
        robot="ur10e",
        validate=validation,
        out=tmp_path,
        parameters=parameters,
    ).to_dict()["validation"]
    assert entry["mean_raw"] == pytest.approx(raw, rel=0.01)


def test_garbage_rows_are_refused_by_line_and_can_be_left_out(tmp_path) -> None:
    path = DATA / "ur10e" / "ur-19_09_27-11_32_02.csv"
    with pytest.raises(DataError, match="20 of 1139 rows") as caught:
        import_recording(path, map_file=MAPS / "ur10e_columns.yaml", out=tmp_path / "a.mcap")
    assert caught.match("line 3: q of joint 2 is -1.612e\\+184 rad")
    report = import_recording(
        path, map_file=MAPS / "ur10e_columns.yaml", out=tmp_path / "b.mcap", drop_bad_rows=True
    )
    data = load_source(report["out"])
    assert len(data) == report["samples"] == 1119
    assert np.max(np.abs(np.diff(data["q"], axis=0))) < 0.05


def test_windows_of_the_map_are_the_authors(tmp_path) -> None:
    name = "ur-20_02_10-30sec_12harm"
    report = import_recording(
        DATA / "ur10e" / f"{name}.csv",
        map_file=MAPS / "ur10e_columns.yaml",
        out=tmp_path / "a.mcap",
    )
    assert report["samples"] == 3691
    assert len(load_source(report["out"])) == 2876


def test_ur10_seven_seconds_predict_the_next_seven(tmp_path) -> None:
    out = tmp_path / "ur10.mcap"
    import_recording(
        DATA / "ur10" / "ur10_exciting_trajectory_first_half.csv",
        map_file=MAPS / "ur10_unisa.yaml",
        out=out,
    )
    data = load_source(out)
    assert (data.effort_unit, len(data)) == ("N·m", 1720)
    half = len(data) // 2
    parts = [_rows(data, slice(0, half)), _rows(data, slice(half, None))]
    model = RigidWls().fit(parts[0], load_model("ur10"))
    errors = evaluate(model, parts[1]).total
    assert np.all(errors.nrmse < [0.4, 0.2, 0.2, 0.3, 0.35, 0.65])
    assert np.all(errors.r > 0.8)


def _rows(data, rows):
    from dataclasses import replace

    columns = {name: values[rows] for name, values in data.columns.items()}
    return replace(data, columns=columns, offsets=np.array([0, len(columns["t"])]))


def test_kr300_positions_velocities_and_torques_have_consistent_units(tmp_path) -> None:
    out = tmp_path / "kr300.mcap"
    import_recording(DATA / "kr300" / "traj_A_data.mat", map_file=MAPS / "kr300_mat.yaml", out=out)
    data = load_source(out)
    assert len(data) == 2501
    slope = np.gradient(data["q"], data["t"], axis=0)
    assert np.std(slope - data["qd"], axis=0) == pytest.approx(0, abs=0.02)
    # A KR300 holds thousands of newton metres at axis 2; motor torques would be a few.
    assert 500 < np.max(np.abs(data["effort"][:, 1])) < 20000
    for joint in range(6):
        assert np.corrcoef(data["qd"][:, joint], data["effort"][:, joint])[0, 1] > 0.5


def test_panda_files_are_put_together(tmp_path) -> None:
    out = tmp_path / "panda.mcap"
    report = import_recording(DATA / "panda", map_file=MAPS / "panda_interleaved.yaml", out=out)
    data = load_source(out)
    assert report["samples"] == 20544
    slope = np.gradient(data["q"], data["t"], axis=0)
    assert np.median(np.abs(slope - data["qd"])) < 0.05
    assert 1 / np.mean(np.diff(data["t"])) == pytest.approx(1000, rel=0.1)


@pytest.mark.thorough
def test_tx40_joints_are_behind_their_gears(tmp_path) -> None:
    out = tmp_path / "tx40.mcap"
    report = import_recording(DATA / "tx40", map_file=MAPS / "tx40_figaroh.yaml", out=out)
    data = load_source(out)
    assert report["samples"] == 45000
    assert data["q"][0] == pytest.approx([0, np.pi / 2, -np.pi / 2, 0, 0, 0], abs=1e-3)
    qd = np.gradient(data["q"], data["t"], axis=0)
    for joint in range(6):
        assert np.corrcoef(qd[::50, joint], data["effort"][::50, joint])[0, 1] > 0.6


def test_loaded_run_shows_the_load_it_was_not_told_about(ur10e, tmp_path) -> None:
    out = tmp_path / "load.mcap"
    name = "ur-20_02_19_14harm50secLoad"
    import_recording(
        DATA / "ur10e" / f"{name}.csv",
        map_file=MAPS / "ur10e_columns.yaml",
        out=out,
        rows=(308, 5071),
    )
    robot = load_model("ur10e")
    model = RigidWls().fit(load_source(ur10e[1][0]), robot)
    ignored = evaluate(model, load_source(out)).total.mean("rmse_raw")
    assert ignored == pytest.approx(0.69, abs=0.03)


def test_whole_trajectories_can_be_held_out_of_pooled_files(ur10e) -> None:
    from hil.data import Dataset

    pooled = Dataset.concatenate([load_source(path) for path in ur10e[0]])
    parts = split(pooled, "trajectory", 1, seed=0)
    assert (len(parts.train.conditions), len(parts.test.conditions)) == (3, 1)
