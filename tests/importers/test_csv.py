"""CSV imports: any layout, units, and bad rows reported with their line numbers."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, RecordingError, SpecError
from hil.importers import ImportMap, import_recording
from hil.importers.sources import load_source, serial_of
from hil.recording import read_info

NAMES = ["a", "b"]


def layout(**changes):
    return ImportMap.model_validate(
        {
            "hil_map": 1,
            "format": "csv",
            "robot": "two-link",
            "joint_names": NAMES,
            "effort_kind": "current",
            "drive_gains_nm_a": [10.0, 5.0],
            "drive_gains_source": "data sheet",
            "columns": {
                "t": {"columns": 1},
                "q": {"columns": "2:3", "unit": "rad"},
                "qd": {"columns": "4:5", "unit": "rad/s"},
                "effort": {"columns": "6:7", "unit": "A"},
            },
        }
        | changes
    )


def columns(**changes):
    base = {
        "t": {"columns": 1},
        "q": {"columns": "2:3", "unit": "rad"},
        "qd": {"columns": "4:5", "unit": "rad/s"},
        "effort": {"columns": "6:7", "unit": "A"},
    }
    return {**base, **changes}


def table(rows=30, dt=0.01):
    t = np.arange(rows) * dt
    return np.column_stack(
        [t, np.sin(t), np.cos(t), np.cos(t), -np.sin(t), np.full(rows, 1.5), np.full(rows, -0.5)]
    )


def written(path, values, delimiter=",", header="", lines=None):
    text = [delimiter.join(f"{v:.9g}" for v in row) for row in values]
    for number, line in (lines or {}).items():
        text[number - 1] = line
    path.write_text((header + "\n" if header else "") + "\n".join(text) + "\n")
    return path


def imported(path, map_, tmp_path, **options):
    out = tmp_path / "out.mcap"
    import_recording(path, map_file=map_, out=out, **options)
    return load_source(out)


def test_plain_table_comes_back_with_its_conditions(tmp_path) -> None:
    values = table()
    path = written(tmp_path / "run.csv", values)
    payload = {"mass_kg": 1.5, "com_m": [0, 0, 0.1]}
    data = imported(path, layout(payload=payload), tmp_path)
    assert data["q"] == pytest.approx(values[:, 1:3])
    assert data["qd"] == pytest.approx(values[:, 3:5])
    assert data["effort"] == pytest.approx(values[:, 5:7])
    assert (data.robot, data.joint_names, data.effort_kind) == ("two-link", ("a", "b"), "current")
    assert data.drive_gains.tolist() == [10.0, 5.0]
    assert data.conditions[0].payload.mass == 1.5
    assert data.conditions[0].payload.com == (0, 0, 0.1)


def test_uneven_time_stamps_are_kept(tmp_path) -> None:
    values = table()
    values[:, 0] = np.cumsum(np.tile([0.010, 0.012], 15))
    data = imported(written(tmp_path / "run.csv", values), layout(), tmp_path)
    assert data["t"] == pytest.approx(values[:, 0], abs=1e-9)


def test_units_scales_offsets_and_signs_are_applied_per_joint(tmp_path) -> None:
    values = table()
    map_ = layout(
        columns=columns(
            t={"columns": 1, "unit": "ms"},
            q={"columns": [3, 2], "unit": "deg", "scale": [1, -1], "offset": [90, 0]},
            qd={"columns": "4:5", "unit": "rpm"},
            effort={"columns": "6:7", "unit": "mA"},
        )
    )
    data = imported(written(tmp_path / "run.csv", values), map_, tmp_path)
    assert data["t"] == pytest.approx(values[:, 0] / 1000)
    assert data["q"][:, 0] == pytest.approx(np.radians(values[:, 2] + 90))
    assert data["q"][:, 1] == pytest.approx(-np.radians(values[:, 1]))
    assert data["qd"] == pytest.approx(values[:, 3:5] * 2 * np.pi / 60)
    assert data["effort"] == pytest.approx(values[:, 5:7] / 1000)


def test_coupled_joints_are_disentangled_by_the_matrix(tmp_path) -> None:
    values = table()
    map_ = layout(
        columns=columns(q={"columns": "2:3", "unit": "rad", "matrix": [[0.5, 0.0], [-0.5, 0.25]]})
    )
    data = imported(written(tmp_path / "run.csv", values), map_, tmp_path)
    motors = values[:, 1:3]
    assert data["q"][:, 0] == pytest.approx(0.5 * motors[:, 0])
    assert data["q"][:, 1] == pytest.approx(0.25 * motors[:, 1] - 0.5 * motors[:, 0])


@pytest.mark.parametrize(("delimiter", "name"), [(";", ";"), ("\t", "\t"), ("   ", "whitespace")])
def test_delimiters_and_header_names(tmp_path, delimiter, name) -> None:
    values = table()
    header = delimiter.join(["time", "q1", "q2", "w1", "w2", "i1", "i2"])
    map_ = layout(
        header=True,
        delimiter=name,
        columns={
            "t": {"columns": "time"},
            "q": {"columns": ["q1", "q2"], "unit": "rad"},
            "effort": {"columns": ["i2", "i1"], "unit": "A"},
        },
    )
    data = imported(written(tmp_path / "run.csv", values, delimiter, header), map_, tmp_path)
    assert data["effort"] == pytest.approx(values[:, [6, 5]])
    assert "qd" not in data.columns


def test_decimal_commas(tmp_path) -> None:
    values = table()
    path = written(tmp_path / "run.csv", values, ";")
    path.write_text(path.read_text().replace(".", ","))
    data = imported(path, layout(delimiter=";", decimal=","), tmp_path)
    assert data["q"] == pytest.approx(values[:, 1:3])


BAD = {
    5: "0.04,nan,1,0,0,1,1",
    9: "0.08,1e111,1,0,0,1,1",
    12: "0.11,0.1,oops,0,0,1,1",
    20: "0.19,0.2,1",
}


def test_bad_rows_are_refused_with_line_numbers_counting_the_header(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table(), header="t,q1,q2,w1,w2,i1,i2", lines=BAD)
    out = tmp_path / "out.mcap"
    with pytest.raises(DataError, match="4 of 30 rows are invalid") as caught:
        import_recording(path, map_file=layout(header=True), out=out)
    for line, why in ((6, "q of joint 1 is nan"), (10, "e\\+111"), (13, "oops"), (21, "3 fields")):
        assert caught.match(rf"line {line}: .*{why}")
    assert "--drop-bad-rows" in caught.value.hint
    assert list(tmp_path.iterdir()) == [path]


def test_bad_rows_are_dropped_on_request_and_noted_in_the_output(tmp_path) -> None:
    values = table()
    path = written(tmp_path / "run.csv", values, lines=BAD)
    out = tmp_path / "out.mcap"
    report = import_recording(path, map_file=layout(), out=out, drop_bad_rows=True)
    assert (report["samples"], report["dropped_lines"]) == (26, [5, 9, 12, 20])
    kept = np.delete(values, [4, 8, 11, 19], axis=0)
    assert load_source(out)["q"] == pytest.approx(kept[:, 1:3])
    noted = read_info(out).metadata["import"]
    assert json.loads(noted["dropped_lines"]) == [5, 9, 12, 20]


def test_only_ten_bad_rows_are_listed_with_their_total(tmp_path) -> None:
    bad = dict.fromkeys(range(3, 18), "x")
    with pytest.raises(DataError, match="15 of 30") as caught:
        imported(written(tmp_path / "run.csv", table(), lines=bad), layout(), tmp_path)
    assert caught.value.message.count("\n  line ") == 10
    assert "5 more" in caught.value.message


def test_a_delimiter_in_quotes_is_part_of_its_field(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table(), lines={7: '0.06,0.1,"0,2",0,0,1'})
    with pytest.raises(DataError, match="line 7: has 6 fields instead of 7"):
        imported(path, layout(), tmp_path)


def test_blank_lines_do_not_shift_line_numbers(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table(), lines={7: "nan,1,1,1,1,1,1"})
    path.write_text("\n\n" + path.read_text())
    with pytest.raises(DataError, match="line 9: t is nan"):
        imported(path, layout(), tmp_path)


def test_repeated_and_backward_time_stamps_are_bad_rows(tmp_path) -> None:
    values = table()
    values[10, 0] = values[9, 0]
    values[20, 0] = values[18, 0] - 0.001
    report = import_recording(
        written(tmp_path / "run.csv", values),
        map_file=layout(),
        out=tmp_path / "o.mcap",
        drop_bad_rows=True,
    )
    assert report["dropped_lines"] == [11, 21]


def test_one_stamp_from_the_future_does_not_condemn_the_rows_after_it(tmp_path) -> None:
    values = table()
    values[10, 0] = 5000.0
    report = import_recording(
        written(tmp_path / "run.csv", values),
        map_file=layout(),
        out=tmp_path / "o.mcap",
        drop_bad_rows=True,
    )
    assert report["dropped_lines"] == [11]


def test_limits_of_the_map_find_garbage_of_plausible_size(tmp_path) -> None:
    map_ = layout(columns=columns(q={"columns": "2:3", "unit": "deg", "limit": 360}))
    path = written(tmp_path / "run.csv", table(), lines={4: "0.03,253,-400,0,0,1,1"})
    with pytest.raises(DataError, match="line 4: q of joint 2 is -400 deg"):
        imported(path, map_, tmp_path)


def test_rows_of_another_pose_are_found_by_the_speed_limit(tmp_path) -> None:
    map_ = layout(columns=columns(qd={"columns": "4:5", "unit": "rad/s", "limit": 3}))
    lines = {15: "0.14,1.9,-1.2,0,0,1,1", 16: "0.15,1.9,-1.2,0,0,1,1"}
    report = import_recording(
        written(tmp_path / "run.csv", table(), lines=lines),
        map_file=map_,
        out=tmp_path / "o.mcap",
        drop_bad_rows=True,
    )
    assert report["dropped_lines"] == [15, 16]


def test_rows_option_counts_from_one_and_includes_both_ends(tmp_path) -> None:
    values = table()
    path = written(tmp_path / "run.csv", values, header="t,q1,q2,w1,w2,i1,i2", lines={2: "bad"})
    data = imported(path, layout(header=True), tmp_path, rows=(5, 30))
    assert data["q"] == pytest.approx(values[4:30, 1:3])


@pytest.mark.parametrize("rows", [(0, 10), (10, 31), (9, 8)])
def test_rows_outside_the_file_are_refused(tmp_path, rows) -> None:
    with pytest.raises(DataError, match="which has rows 1:30"):
        imported(written(tmp_path / "run.csv", table()), layout(), tmp_path, rows=rows)


def test_windows_of_the_map_become_trajectories(tmp_path) -> None:
    values = table(60)
    windows = [{"rows": "3:22"}, {"rows": "31:55", "file": "run*"}, {"rows": "1:9", "file": "x"}]
    data = imported(written(tmp_path / "run.csv", values), layout(windows=windows), tmp_path)
    assert [c.trajectory for c in data.conditions] == [0, 1]
    assert np.diff(data.offsets).tolist() == [20, 25]
    assert data["t"][20] == pytest.approx(values[30, 0])


def test_column_beyond_the_file_is_one_clear_error(tmp_path) -> None:
    map_ = layout(columns=columns(effort={"columns": "8:9", "unit": "A"}))
    with pytest.raises(DataError, match=r"reads column 9, but the rows of .* have 7 columns"):
        imported(written(tmp_path / "run.csv", table()), map_, tmp_path)


def test_optional_quantity_may_be_missing(tmp_path) -> None:
    more = {"columns": "8:9", "unit": "A", "optional": True}
    data = imported(
        written(tmp_path / "run.csv", table()),
        layout(columns=columns(effort_target=more)),
        tmp_path,
    )
    assert "effort_target" not in data.columns


def test_missing_named_column_comes_with_a_guess(tmp_path) -> None:
    map_ = layout(header=True, columns=columns(t={"columns": "tiem"}))
    path = written(tmp_path / "run.csv", table(), header="time,q1,q2,w1,w2,i1,i2")
    with pytest.raises(DataError, match="no column 'tiem'") as caught:
        imported(path, map_, tmp_path)
    assert "'time'" in caught.value.hint


def test_existing_output_is_not_replaced(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table())
    imported(path, layout(), tmp_path)
    with pytest.raises(RecordingError, match="exists already"):
        imported(path, layout(), tmp_path)


def test_file_of_garbage_leaves_nothing_even_when_rows_may_be_dropped(tmp_path) -> None:
    path = written(tmp_path / "run.csv", np.full((20, 7), 1e111))
    with pytest.raises(DataError, match="only 0 of 20 rows are valid"):
        imported(path, layout(), tmp_path, drop_bad_rows=True)
    assert list(tmp_path.iterdir()) == [path]


def test_binary_file_is_refused(tmp_path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(b"\x89MCAP0\r\n\xff\xfe")
    with pytest.raises(DataError, match="not a text file"):
        imported(path, layout(), tmp_path)


def test_recorder_csv_of_ur_rtde_needs_no_column_names(tmp_path) -> None:
    names = ["timestamp"]
    names += [f"actual_q_{j}" for j in range(2)]
    names += [f"actual_current_{j}" for j in range(2)]
    values = table()[:, [0, 1, 2, 5, 6]]
    path = written(tmp_path / "run.csv", values, header=",".join(names))
    map_ = layout(
        format="ur_rtde",
        columns={
            "q": {"unit": "rad"},
            "qd": {"unit": "rad/s"},
            "effort": {"unit": "A"},
            "temperature": {"unit": "c"},
        },
    )
    data = imported(path, map_, tmp_path)
    assert data["effort"] == pytest.approx(values[:, 3:5])
    assert set(data.columns) == {"t", "q", "effort"}


def test_format_can_be_overridden_and_slips_are_named(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table())
    with pytest.raises(SpecError, match="unknown import format 'cvs'") as caught:
        imported(path, layout(), tmp_path, format_="cvs")
    assert "'csv'" in caught.value.hint


NOTED = "no load declared: 0 kg assumed"


def loads(data):
    return [(c.load, c.payload.mass) for c in data.conditions]


def test_load_that_nobody_declared_is_said_to_count_as_none(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table())
    (note,) = import_recording(path, map_file=layout(), out=tmp_path / "a.mcap")["notes"]
    assert note.startswith(NOTED)
    assert "--payload" in note


def test_declared_load_is_said(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table())
    for mass in (0.0, 2.805):
        map_ = layout(payload={"mass_kg": mass})
        report = import_recording(path, map_file=map_, out=tmp_path / f"{mass}.mcap")
        assert report["notes"] == [f"declared load: {mass:g} kg"]


def test_load_given_with_the_import_wins_over_the_maps(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table(60))
    windows = [{"rows": "1:30", "payload": {"mass_kg": 5}}, {"rows": "31:60"}]
    map_ = layout(payload={"mass_kg": 1.0}, windows=windows)
    data = imported(path, map_, tmp_path, payload=Payload(2.805, (0, 0, 0.05)))
    assert {c.payload for c in data.conditions} == {Payload(2.805, (0, 0, 0.05))}


def test_windows_may_have_loads_of_their_own(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table(90))
    windows = [
        {"rows": "1:30"},
        {"rows": "31:60", "payload": {"mass_kg": 2.805, "com_m": [0, 0, 0.1]}},
        {"rows": "61:90"},
    ]
    report = import_recording(path, map_file=layout(windows=windows), out=tmp_path / "out.mcap")
    data = load_source(report["out"])
    assert loads(data) == [(0, 0.0), (1, 2.805), (0, 0.0)]
    assert data.conditions[1].payload.com == (0, 0, 0.1)
    assert "declared load of rows 31:60: 2.805 kg" in report["notes"]
    assert any(note.startswith("no load declared for the other rows") for note in report["notes"])


def test_renamed_file_that_misses_its_window_is_noted(tmp_path) -> None:
    map_ = layout(windows=[{"file": "run*.csv", "rows": "5:20"}])
    path = written(tmp_path / "renamed.csv", table())
    note = "no window of the map matches renamed.csv: all rows used"
    assert note in import_recording(path, map_file=map_, out=tmp_path / "a.mcap")["notes"]
    assert (
        note
        not in import_recording(path, map_file=map_, out=tmp_path / "b.mcap", rows=(5, 20))["notes"]
    )
    path = written(tmp_path / "run1.csv", table())
    assert note not in import_recording(path, map_file=map_, out=tmp_path / "c.mcap")["notes"]


def test_serial_number_of_the_map_stays_with_the_recording(tmp_path) -> None:
    path = written(tmp_path / "run.csv", table())
    report = import_recording(path, map_file=layout(serial="2019-0815"), out=tmp_path / "out.mcap")
    assert serial_of(report["out"]) == "2019-0815"


def test_command_line_declares_the_load_and_says_so(tmp_path) -> None:
    path, out = written(tmp_path / "run.csv", table()), tmp_path / "out.mcap"
    map_ = tmp_path / "map.yaml"
    map_.write_text(layout().model_dump_json(exclude_unset=True))  # JSON is YAML
    command = [
        "import",
        str(path),
        "--map",
        str(map_),
        "-o",
        str(out),
        "--payload",
        "2.805,0,0,0.1",
    ]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "declared load: 2.805 kg" in result.output
    assert load_source(out).conditions[0].payload == Payload(2.805, (0, 0, 0.1))


def test_degrees_declared_as_radians_are_noticed_on_a_known_arm(tmp_path) -> None:
    rows = np.arange(30)
    q_deg = np.full((30, 6), 40.0)
    values = np.column_stack([rows * 0.01, q_deg, np.ones((30, 6))])
    map_ = layout(
        robot="ur5",
        joint_names=[f"j{i}" for i in range(1, 7)],
        drive_gains_nm_a=[10.0] * 6,
        columns={
            "t": {"columns": 1},
            "q": {"columns": "2:7", "unit": "rad"},
            "effort": {"columns": "8:13", "unit": "A"},
        },
    )
    with pytest.raises(DataError, match="more than a ur5 can turn"):
        imported(written(tmp_path / "run.csv", values), map_, tmp_path)
