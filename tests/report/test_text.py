"""Text of reports: the summary for a terminal, values with units, tables of models."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.cli.output import print_run
from hil.core import parse_parameters
from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.report import summary_lines
from hil.report.model_sections import per_group, per_joint
from hil.report.words import measure, measures, named, size
from hil.runs.listing import list_runs
from hil.studies.store import write_study
from tests.support.report_runs import JOINTS, dwell_plan, fourier_plan, rows_of_plan, write_run
from tests.support.study_parts import result

# The summary for a terminal


def judged(tmp_path, **more):
    """A run whose evaluation is written by hand, with numbers that are easy to find."""
    run = write_run(tmp_path, fourier_plan(), **more)
    folder = run.path / "fit" / "rigid-wls-0123456789ab"
    folder.mkdir(parents=True)
    total = {
        "rmse_raw": [0.111, 0.222, 0.333, 0.444, 0.555, 0.666],
        "rmse_filtered": [0.011, 0.022, 0.033, 0.044, 0.055, None],
        "noise_floor": [0.001] * 6,
        "mean_raw": 0.3885,
        "mean_filtered": 0.033,
    }
    row = {"metric": "rmse_raw", "per": "joint", "max": 0.5, "unit": "A"}
    rows = [
        {**row, "what": name, "value": value, "passed": value <= 0.5}
        for name, value in zip(JOINTS, total["rmse_raw"], strict=True)
    ]
    held_out = {"what": "trajectory 2", "unit": "A", "joint_names": list(JOINTS), "total": total}
    document = {"estimator": "rigid-wls", "held_out": held_out, "verdict": {"rows": rows}}
    (folder / "evaluation.json").write_text(json.dumps(document))
    named = [{"estimator": "rigid-wls", **row} for row in rows]
    (run.path / "verdict.json").write_text(json.dumps({"passed": False, "rows": named}))
    return run


def test_no_line_is_wider_than_a_terminal_except_paths(tmp_path):
    run = judged(tmp_path, name="a-" + "long-" * 11 + "name")
    for line in summary_lines(run.path):
        assert len(line) <= 80 or str(tmp_path) in line, line


def test_the_verdict_comes_first_and_says_which_criterion_was_missed_by_whom(tmp_path):
    lines = summary_lines(judged(tmp_path).path)
    text = " ".join(" ".join(lines).split())
    assert lines[0].startswith("REJECTED")
    assert "RMSE raw ≤ 0.5 A by 2 of 6 joints, worst wrist_3_joint with 0.666 A" in text


def test_the_table_holds_the_numbers_of_the_evaluation(tmp_path):
    lines = summary_lines(judged(tmp_path).path)
    assert "J3 elbow_joint                    0.333     0.0330    0.00100          –" in lines
    assert next(line for line in lines if line.startswith("mean")).split()[1] == "0.389"


def test_an_interrupted_run_is_called_interrupted(tmp_path):
    run = write_run(tmp_path, fourier_plan(), outcome=None)
    lines = summary_lines(run.path)
    assert lines[0].startswith("INTERRUPTED")
    assert "Measured: 0 of 3 trajectories" in " ".join(lines)


def test_late_samples_are_counted_and_explained(tmp_path):
    run = write_run(tmp_path, fourier_plan())
    assert "came late" not in " ".join(summary_lines(run.path))
    stop = run.path / "stop.json"
    stop.write_text(json.dumps(json.loads(stop.read_text()) | {"overruns": 571}))
    text = " ".join(" ".join(summary_lines(run.path)).split())
    said = "571 samples came late (more than 1.5 periods after the one before; none is lost)"
    assert said in text


def cut_off(tmp_path):
    """A run that was killed: its recording is torn, nothing says how it ended."""
    plan = dwell_plan()
    return write_run(tmp_path, plan, rows=rows_of_plan(plan)[:700], outcome=None, finish=False)


def test_an_interrupted_run_tells_what_its_data_tells(tmp_path):
    run = cut_off(tmp_path)
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert "recorded 700 samples in 5.6 s; 0 missing in 0 gaps, 0 duplicates" in text
    assert "measured 20 of 48 dwells, 5 of 10 references" in text
    (listed,) = list_runs(tmp_path)
    assert listed["duration_s"] == pytest.approx(699 / 125)


def test_a_run_that_goes_on_is_called_running_and_tells_the_same(tmp_path):
    run = cut_off(tmp_path)
    with hold_run(run.path):
        lines = summary_lines(run.path)
    assert lines[0].startswith("RUNNING")
    text = " ".join(" ".join(lines).split())
    assert "measured 20 of 48 dwells, 5 of 10 references" in text
    assert "hil resume" not in text


def test_a_resumed_run_that_was_killed_counts_both_attempts(tmp_path):
    run = cut_off(tmp_path)
    first = run.path / "recording" / "00.mcap.partial"
    (run.path / "recording" / "01.mcap.partial").write_bytes(first.read_bytes())
    (run.path / "resume-01.json").write_text('{"hil_run": 1, "attempt": 1}')
    assert "1400 samples in 11.2 s" in " ".join(" ".join(summary_lines(run.path)).split())


def test_a_finished_recording_that_was_cut_off_is_a_warning(tmp_path):
    run = write_run(tmp_path, fourier_plan())
    file = run.path / "recording" / "00.mcap"
    assert "torn" not in " ".join(summary_lines(run.path))
    file.write_bytes(file.read_bytes()[:-100])
    told = " ".join(" ".join(summary_lines(run.path)).split())
    assert f"00.mcap was finished but is truncated: hil recover {run.path}" in told


def test_lines_in_the_log_that_are_no_events_are_counted(tmp_path):
    run = write_run(tmp_path, fourier_plan())
    log = run.path / "events.jsonl"
    log.write_bytes(log.read_bytes() + b'{"t": 17, "ti')  # what a crash leaves is no news
    assert "not an event" not in " ".join(summary_lines(run.path))
    log.write_bytes(log.read_bytes() + b'\n\xff\x00garb\x80age\n[]\n{"kind"\nnull\n')
    assert "events.jsonl contains 4 lines that are not events" in " ".join(summary_lines(run.path))
    assert run.verify() == ["events.jsonl contains 4 lines that are not events: a different "
                            "program wrote to it"]  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["plan.json", "start.json"])
@pytest.mark.parametrize("content", ['{"steps": 3}', "{}", "{", "[]"])
def test_a_run_with_a_damaged_document_is_not_offered_to_be_resumed(tmp_path, name, content):
    run = stopped_early(tmp_path, fourier_plan())
    (run.path / name).write_text(content)
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert "hil resume" not in text
    assert f"Warning: {run.path / name} " in text


def test_a_reason_keeps_its_lines(tmp_path):
    reason = "weighing: load 1: 3 kg declared, 1 kg weighed\n  torque it adds:\n  elbow: 0.1, 0.2"
    run = stopped_early(tmp_path, fourier_plan())
    stop = run.path / "stop.json"
    stop.write_text(json.dumps(json.loads(stop.read_text()) | {"reason": reason}))
    lines = summary_lines(run.path)
    assert "  torque it adds:" in lines
    assert any(line.startswith("  elbow: 0.1, 0.2.") for line in lines)


def test_one_of_a_kind_is_no_plural(tmp_path):
    run = stopped_early(tmp_path, fourier_plan(), missing=38, gaps=1, duplicates=1)
    assert "38 missing in 1 gap, 1 duplicate" in " ".join(" ".join(summary_lines(run.path)).split())


def test_a_tripped_run_gives_its_reason(tmp_path):
    plan = fourier_plan()
    rows = rows_of_plan(plan)[:500]
    run = write_run(tmp_path, plan, rows=rows, outcome="tripped", reason="interlock speed: J2 fast")
    assert "interlock speed: J2 fast" in " ".join(summary_lines(run.path))


def stopped_early(tmp_path, plan, **stop):
    """A run that failed, with more in its stop document than the shared writer puts there."""
    run = write_run(tmp_path, plan, rows=rows_of_plan(plan)[:500], outcome="failed", reason="why")
    path = run.path / "stop.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | stop))
    return run


def test_a_run_that_ended_early_says_where_and_how_to_go_on(tmp_path):
    run = stopped_early(tmp_path, fourier_plan(), steps_done=3)
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert "3 of 6 steps; ended in step 4, trajectory 1" in text
    assert f"resume: hil resume {run.path}" in text


def test_what_was_measured_is_counted_by_the_data(tmp_path):
    counts = {"trajectory": {"done": 1, "of": 3}, "reference": {"done": 2, "of": 2}}
    run = stopped_early(tmp_path, fourier_plan(), steps_done=3, complete=counts)
    assert "1 of 3 trajectories, 2 of 2 references" in " ".join(summary_lines(run.path))


def test_what_went_wrong_on_the_way_out_is_a_warning(tmp_path):
    run = stopped_early(
        tmp_path, fourier_plan(), problems=["standstill of the arm was not confirmed"]
    )
    assert "Warning: standstill of the arm was not confirmed" in summary_lines(run.path)


def test_a_run_that_ended_in_preflight_moved_nothing(tmp_path):
    run = stopped_early(tmp_path, fourier_plan(), steps_done=0)
    log = run.path / "events.jsonl"
    log.write_text('{"t": 0, "time": "", "kind": "state", "state": "preflight"}\n')
    assert "ended in preflight, before anything moved" in " ".join(summary_lines(run.path))


def test_a_resumed_run_tells_of_its_last_attempt(tmp_path):
    run = stopped_early(tmp_path, fourier_plan())
    stop = json.loads((run.path / "stop.json").read_text())
    (run.path / "resume-01.json").write_text('{"hil_run": 1, "attempt": 1}')
    again = stop | {"attempt": 1, "outcome": "stopped", "reason": "another reason"}
    (run.path / "stop-01.json").write_text(json.dumps(again))
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert "The run was stopped early: another reason" in text
    assert "why" not in text
    assert f"program {stop['steps_done']} of {len(fourier_plan())} steps, in 2 attempts" in text


def test_a_narrow_terminal_gets_narrow_lines(tmp_path):
    run = judged(tmp_path, name="fourier-with-a-name-that-goes-on")
    for line in summary_lines(run.path, 60):
        assert len(line) <= 60 or str(tmp_path) in line, line


@pytest.mark.parametrize("width", [50, 80])
def test_names_of_joints_are_never_shortened(tmp_path, width):
    lines = summary_lines(judged(tmp_path).path, width)
    assert all(len(line) <= width or str(tmp_path) in line for line in lines)
    for j, name in enumerate(JOINTS, start=1):
        (line,) = [line for line in lines if line.startswith(f"J{j} ")]
        assert name in line


def test_show_in_a_pipe_knows_no_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "50")
    print_run(judged(tmp_path).path)
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith("J1 ")]
    assert len(table[0]) > 50


def test_without_a_report_the_command_for_one_is_shown(tmp_path):
    run = write_run(tmp_path, fourier_plan())
    assert f"hil report {run.path}" in " ".join(summary_lines(run.path))


def test_a_fit_that_is_missing_is_offered_with_the_parameters_of_the_spec(tmp_path):
    run = write_run(tmp_path, dwell_plan())
    given = {"layers": [4, 8, 1], "form": "it's 5", "seed": 3, "averaging": False}
    spec = run.path / "spec.yaml"
    entry = json.dumps({"estimator": "static-mlp-lm", **given})
    spec.write_text(spec.read_text().replace("{estimator: static-wls}", entry))
    run.write_verdict({"passed": None, "rows": []})
    (line,) = [line for line in summary_lines(run.path) if "hil fit" in line]
    words = shlex.split(line.removeprefix("next: "))
    assert words[:5] == ["hil", "fit", str(run.path), "--estimator", "static-mlp-lm"]
    assert words[5::2] == ["--set"] * len(given)
    assert parse_parameters(words[6::2]) == given


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(DataError, match="is not a run directory"):
        summary_lines(tmp_path)


def test_importing_the_report_loads_neither_plotly_nor_jinja():
    code = (
        "import sys, hil.report; print([m for m in ('plotly', 'jinja2', 'mujoco', 'pinocchio', "
        "'sklearn', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("kind", "words"), [("dwell", "payload MODEL"), ("fourier", "fit")])
def test_a_run_without_a_fit_says_what_comes_next(tmp_path, kind, words):
    directory = write_run(tmp_path, dwell_plan(poses=2))
    directory.write_verdict({"passed": None, "rows": []})
    run = directory.path
    text = f"hil: 1\nname: dwells\nrobot: ur5\nexcitation: {{kind: {kind}}}\n"
    (run / "spec.yaml").write_text(text)
    lines = summary_lines(run)
    assert any(line.startswith(f"next: hil {words}") for line in lines)
    (run / "spec.yaml").write_text(f"{text}study: [{{study: counted}}]\n")
    write_study(result(), run / "study" / "counted-1")
    assert not any(line.startswith(f"next: hil {words}") for line in summary_lines(run))


def test_the_summary_names_the_folder_of_a_model(tmp_path):
    run = judged(tmp_path).path
    (run / "fit" / "rigid-wls-0123456789ab" / "model.json").write_text("{}")
    assert f"model      {run / 'fit' / 'rigid-wls-0123456789ab'}" in summary_lines(run)


# Values with units, as a person reads them in passing


NARROW = "\u202f"


@pytest.mark.parametrize(
    ("value", "unit", "said"),
    [(0.35, "A", "0.350 A"), (4.658e-5, "rad", "0.0466 mrad"), (2e-7, "m", "0.200 µm"),
     (47137, "MB", "47.1 GB"), (0.5, "MB", "500 kB"), (999.9996, "MB", "1.00 GB"),
     (1234.4, "N·m", f"1{NARROW}234 N·m"), (21.5625, "°C", "21.6 °C"), (0, "rad", "0 rad"),
     (1e-5, "1", "< 0.001"), (-1e-5, "°C", "> -0.001 °C"), (3.25, None, "3.25"),
     (-3.2e-4, "A", "-0.320 mA")],
)  # fmt: skip
def test_a_value_has_the_unit_that_suits_it(value: float, unit: str, said: str) -> None:
    assert measure(value, unit) == said


@pytest.mark.parametrize("value", [None, "x", True, [1], float("nan"), float("inf"), 10**400])
def test_what_is_no_number_is_not_known(value: object) -> None:
    assert measure(value, "A") == "–"
    assert measures(value, 2.0, "A") == ("–", "2 A")
    assert measures(2.0, value, "A") == ("2.00 A", "–")


@pytest.mark.parametrize(
    ("value", "limit", "unit", "said"),
    [(4.658e-5, 0.02, "rad", ("0.0466 mrad", "20 mrad")),
     (4.658e-5, 0.5, "rad", ("< 0.001 rad", "0.5 rad")),
     (47137, 500, "MB", ("47.1 GB", "0.5 GB")),
     (0.3, 150.0, "N·m", ("0.300 N·m", "150 N·m")),
     (45.62, 142.5, "N·m", ("45.6 N·m", "142.5 N·m")),
     (12.3, 250, "mm", ("12.3 mm", "250 mm")),
     (45, 999.7, "N·m", ("45.0 N·m", "999.7 N·m")),
     (45, 1047.6, "N·m", ("45.0 N·m", f"1{NARROW}047.6 N·m")),
     (0.3, 0.0005, "rad", ("0.300 rad", "0.0005 rad")),
     (0.1, 0.312345, "rad", ("0.100 rad", "0.312345 rad")),
     (150.4, 150, "N·m", ("150.4 N·m", "150 N·m")),
     (-150.04, -150, "N·m", ("-150.04 N·m", "-150 N·m")),
     (0.02004, 0.02, "rad", ("20.04 mrad", "20 mrad")),
     (1000.4, 1000.2, "W", (f"1{NARROW}000.4 W", f"1{NARROW}000.2 W")),
     (0.04996, 0.05, "m", ("49.96 mm", "50 mm")),
     (150, 150, "N·m", ("150 N·m", "150 N·m")),
     (150 * (1 + 1e-15), 150, "N·m", ("150 N·m", "150 N·m"))],
)  # fmt: skip
def test_a_value_and_its_limit_are_in_one_unit(
    value: float, limit: float, unit: str, said: tuple[str, str]
) -> None:
    assert measures(value, limit, unit) == said


@pytest.mark.parametrize("value", [np.float32(3), np.float64(3), np.int64(3), 3])
def test_numbers_of_numpy_are_numbers(value: object) -> None:
    assert measure(value, "A") == "3.00 A"


def test_sizes_of_files() -> None:
    told = [size(n) for n in (0, 532, 999.6, 999_999, 46_338, 3e12)]
    assert told == ["0 B", "532 B", "1.00 kB", "1.00 MB", "46.3 kB", f"3{NARROW}000 GB"]
    assert [size(n) for n in (999.4, float("nan"), float("inf"))] == ["999 B", "–", "–"]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [("velocity_rad_s", 1.639e-4, ("velocity", "0.164 mrad/s")),
     ("clearance_m", 0.021977, ("clearance", "0.0220 m")),
     ("effort_nm", 26.226, ("effort", "26.2 N·m")),
     ("ratio", None, ("ratio", "–"))],
)  # fmt: skip
def test_a_key_says_the_unit(key: str, value: object, said: tuple[str, str]) -> None:
    assert named(key, value) == said


# Tables of a model say what its numbers do not mean


def fit_with(*nrmse: float) -> Any:
    """A model with such NRMSE on its training data; everything else is 0.1."""
    names = tuple(f"joint_{j}" for j in range(len(nrmse)))

    def values(metric: str, of: str = "held_out") -> Any:
        return np.array(nrmse if (metric, of) == ("nrmse", "trained") else [0.1] * len(nrmse))

    return SimpleNamespace(
        label="wls", unit="A", fast_part="noise", criteria=[], joint_names=names,
        values=values, mean=lambda metric, of="held_out": 0.1,
    )  # fmt: skip


@pytest.mark.parametrize(("nrmse", "named"), [((0.1, 0.99), "joint_1"), ((0.1, 0.2), "")])
def test_an_nrmse_of_1_is_explained_where_a_joint_is_hardly_loaded(
    nrmse: tuple[float, ...], named: str
) -> None:
    note = per_joint(fit_with(*nrmse)).note
    said = f"An NRMSE near 1 is not a fault of the model for {named}:"
    assert note.startswith(said) is bool(named)


@pytest.mark.parametrize(("count", "said"), [(2, True), (1, False)])
def test_how_trajectories_are_counted_is_said_where_several_are_listed(
    count: int, said: bool
) -> None:
    fit = fit_with(0.1)
    named = [("trajectory", f"run#{n}") for n in range(count)] + [("kind", "a"), ("kind", "b")]
    fit.held_out = {"tables": [{"by": by, "name": name, "samples": 9} for by, name in named]}
    table = per_group(fit)
    assert table is not None
    assert ("counted from 0" in table.note) is said
