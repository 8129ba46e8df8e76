"""Repeat what a trial by a new user and an attack found; print what happens now, a line each.

    python -m tests.proofs.findings              # all of them
    python -m tests.proofs.findings B1 B10       # these

The numbers are those of the list that was made on revision 48f2337. Each function repeats one
entry in a folder of its own, raises `AssertionError` if the defect is back, and returns what
happens now in one sentence. Exit code 1 if a defect is back. The tests of the same behaviour are
in `test_*.py`; this script shows all of it in one place and in minutes.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tests.support.mock_servers import mock_ur
from tests.support.paths import ROOT

Finding = Callable[[Path], str]

FINDINGS: dict[str, tuple[str, Finding]] = {}

REPOSITORY = ROOT


def finding(number: str, title: str) -> Callable[[Finding], Finding]:
    """Enter a function that repeats one entry of the list."""

    def enter(function: Finding) -> Finding:
        FINDINGS[number] = title, function
        return function

    return enter


def hil(
    *arguments: object, cwd: Path, timeout_s: float = 300.0, stdin: str = "", **env: str
) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, with neither terminal nor user settings."""
    return subprocess.run(
        [sys.executable, "-m", "hil", *map(str, arguments)],
        cwd=cwd,
        input=stdin,
        capture_output=True,
        text=True,
        errors="backslashreplace",
        timeout=timeout_s,
        check=False,
        env=os.environ | {"NO_COLOR": "1", "COLUMNS": "100"} | env,
    )


def last_line(text: str) -> str:
    """Return the last line that is not empty."""
    return next((line for line in reversed(text.splitlines()) if line.strip()), "").strip()


def wait_for(what: Callable[[], Any], name: str, within_s: float = 120.0) -> Any:
    """Return what a look brings as soon as it brings something."""
    until = time.monotonic() + within_s
    while True:
        with contextlib.suppress(OSError, ValueError):
            if answer := what():
                return answer
        assert time.monotonic() < until, f"{name} has not come within {within_s:g} s"
        time.sleep(0.02)


def hil_in_background(*arguments: object, cwd: Path) -> subprocess.Popen[str]:
    """Start the command line without waiting for its end."""
    return subprocess.Popen(
        [sys.executable, "-m", "hil", *map(str, arguments)],
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"NO_COLOR": "1", "COLUMNS": "100"},
    )


# ---- A1 commissioning ---------------------------------------------------------------------------


def tutorial_file(name: str) -> str:
    """Return a file as the tutorial of the first run on a real arm has it."""
    text = (REPOSITORY / "docs/tutorial/first-real-ur5.md").read_text("utf-8")
    match = re.search(rf"<!-- file: {re.escape(name)} -->\n```yaml\n(.*?)```", text, re.DOTALL)
    assert match, f"the tutorial has no {name}"
    return match[1]


@finding("A1", "commissioning run of the tutorial")
def commissioning(folder: Path) -> str:
    (folder / "first.yaml").write_text(tutorial_file("first.yaml"))
    with mock_ur("--speed", "4") as mock:
        at_mock = f"address: {mock.address}, watchdog_hz: 0.2, late_s: 5.0, lag_s: 1.0"
        station = tutorial_file("station.yaml").replace("address: 192.168.0.5", at_mock)
        (folder / "station.yaml").write_text(station)
        options = ("--station", "station.yaml", "--speed-scale", "10%", "--limit", "3")
        done = hil("run", "first.yaml", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    before, begins, _ = done.stderr.partition("running first-ur5")
    assert begins
    swept = [" ".join(line.split()) for line in before.splitlines() if line.startswith("  ")]
    assert [line.split()[0] for line in swept[-2:]] == ["flange", "elbow"], swept
    (stop,) = (folder / "runs").glob("*/ur5/*/stop.json")
    robot_s = json.loads(stop.read_text())["device_s"]
    assert robot_s <= 120, f"{robot_s:.0f} s of robot time"
    return f"three poses in {robot_s:.0f} s of robot time; printed first: {'; '.join(swept)}"


# ---- A2 confirmation of a real robot ------------------------------------------------------------

REAL_ARM = """
from hil.robot import Address
from hil_mock_robot.embedded.robot import MockRobot


class RealArm(MockRobot):
    def __init__(self, name, model, *, at, **options):
        super().__init__(name, model, **options)
        self.address = Address(at)
"""
"""A driver whose arm says that it is a real one: what moves is the embedded mock."""


def typing(answer: str, *arguments: object, cwd: Path, **env: str) -> tuple[int, str]:
    """Run the command line on a terminal; type an answer when it asks for the robot's name."""
    command = [sys.executable, "-m", "hil", *map(str, arguments)]
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(cwd)
        os.execvpe(command[0], command, os.environ | {"NO_COLOR": "1"} | env)
    shown, asked = b"", False
    with contextlib.suppress(OSError):  # the process has ended, and its terminal with it
        while select.select([terminal], [], [], 300.0)[0] and (text := os.read(terminal, 65536)):
            shown += text
            if not asked and b" to move this robot" in shown:
                asked = os.write(terminal, answer.encode()) > 0
    os.close(terminal)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), shown.decode(errors="replace")


@finding("A2", "a real robot is named or confirmed")
def real_robot_is_confirmed(folder: Path) -> str:
    spec, station = folder / "dw.yaml", folder / "station.yaml"
    spec.write_text(
        "hil: 1\nname: dw\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 4}\n"
        "loads: [{mass_kg: 0}, {mass_kg: 1, com_m: [0, 0, 0.05], prompt: Mount it}]\n"
        "warm_up: {duration_s: 2}\nweigh: {poses: 0}\n"
    )
    station.write_text(
        "hil_station: 1\nrobots:\n  ur5: {driver: ur, model: ur5, options: {address: 192.0.2.5}}\n"
    )
    bare = hil("run", "dw.yaml", cwd=folder)
    assert bare.returncode == 3, bare.stderr
    assert "192.0.2.5 is a real robot" in bare.stderr, bare.stderr
    assert not (folder / "runs").exists()

    info = folder / "real_arm-1.dist-info"
    info.mkdir()
    (folder / "real_arm.py").write_text(REAL_ARM)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: real-arm\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[hil.drivers]\nreal-arm = real_arm:RealArm\n")
    station.write_text(
        "hil_station: 1\nrobots:\n  ur5:\n    driver: real-arm\n    model: ur5\n"
        "    options: {at: 198.51.100.7}\n    checklist: [The emergency stop is within reach.]\n"
    )
    path = {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    wrong, _ = typing("ur\n", "run", "dw.yaml", cwd=folder, **path)
    assert wrong == 3, wrong
    assert not list(folder.glob("runs/*/*/*")), "something was run"
    stopped, _ = typing("\x03", "run", "dw.yaml", cwd=folder, **path)
    assert stopped == 130, stopped
    # The run stops at a prompt that is answered with no, so that there is something to resume.
    (folder / "no.yaml").write_text("[{prompt: Mount it, answer: no}]\n")
    (folder / "yes.yaml").write_text("[{prompt: Mount it, answer: yes}]\n")
    code, shown = typing("ur5\n", "run", "dw.yaml", "--answers", "no.yaml", cwd=folder, **path)
    assert code == 6, shown
    for said in ("198.51.100.7", "wrist_3_joint", "elbow", "emergency stop", "1 kg at"):
        assert said in shown, shown
    (run,) = folder.glob("runs/*/*/*")
    answer = json.loads((run / "start.json").read_text())["confirmation"]
    assert answer["how"] == "typed", answer
    assert answer["facts"]["address"] == "198.51.100.7", answer

    resume = ("resume", run, "--answers", "no.yaml")
    same = hil(*resume, cwd=folder, **path)
    assert same.returncode == 6, same.stderr  # the prompt stopped it again: it was not asked
    copy = run / "station.yaml"
    copy.write_text(copy.read_text().replace("198.51.100.7", "198.51.100.8"))
    other = hil(*resume, cwd=folder, **path)
    assert other.returncode == 3, other.stderr
    code, shown = typing("ur5\n", "resume", run, "--answers", "yes.yaml", cwd=folder, **path)
    assert code == 0, shown
    again = json.loads((run / "resume-02.json").read_text())["confirmation"]
    assert again["facts"]["address"] == "198.51.100.8", again
    return (
        "a bare run beside a station at 192.0.2.5 ends with code 3 and connects to nothing; "
        "'ur' and Ctrl-C move nothing (3, 130), 'ur5' moves it and is recorded; resume asks "
        "nothing, at another address again"
    )


@finding("A2s", "schedules, series and fleets of real robots")
def unattended_robots_are_armed(folder: Path) -> str:
    """A real robot must be in the file with its address, and be armed or confirmed at the start."""
    from tests.support.pipeline_parts import SCHEDULE, write_schedule

    at, named = "198.51.100.7", {"robots": {"ur5": "198.51.100.7"}}
    info = folder / "real_arm-1.dist-info"
    info.mkdir()
    (folder / "real_arm.py").write_text(REAL_ARM)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: real-arm\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[hil.drivers]\nreal-arm = real_arm:RealArm\n")
    path = {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    station = folder / "station.yaml"
    station.write_text(
        f"hil_station: 1\nrobots:\n  ur5: {{driver: real-arm, model: ur5, options: {{at: {at}}}}}\n"
    )
    series = {"hil_series": 1, "name": "one", "series": [{"spec": "probe.yaml"}]}
    (folder / "series.yaml").write_text(json.dumps(series))
    write_schedule(folder)
    fleet = ("fleet", "run", "probe.yaml", "--robots", "ur*")
    for words in (("reidentify", "weekly.yaml"), ("run", "series.yaml"), fleet):
        unnamed = hil(*words, cwd=folder, **path)
        assert unnamed.returncode == 2, unnamed.stderr
        assert f"ur5 is a real robot at {at}" in unnamed.stderr, unnamed.stderr
    write_schedule(folder, schedule=SCHEDULE | named)
    (folder / "series.yaml").write_text(json.dumps(series | named))
    (folder / "arms.yaml").write_text(json.dumps({"hil_fleet": 1} | named))
    starts = (
        ("schedule", "run", "weekly.yaml", "--once"),
        ("reidentify", "weekly.yaml"),
        ("run", "series.yaml"),
        (*fleet[:-1], "arms.yaml"),
    )
    for words in starts:
        refused = hil(*words, cwd=folder, **path)
        assert refused.returncode == 3, refused.stderr
    assert not list(folder.glob("runs/*/*/*/start.json")), "something was run"
    armed = hil("schedule", "arm", "weekly.yaml", "--yes", cwd=folder, **path)
    assert armed.returncode == 0, armed.stderr
    ran = hil("reidentify", "weekly.yaml", cwd=folder, **path)
    assert ran.returncode == 0, ran.stderr
    begun = [json.loads(one.read_text()) for one in folder.glob("runs/*/ur5/*/start.json")]
    assert {one["confirmation"]["how"] for one in begun} == {"armed"}, begun
    for old, new in ((at, "198.51.100.8"), ("198.51.100.8", at)):
        station.write_text(station.read_text().replace(old, new))
        again = hil("reidentify", "weekly.yaml", cwd=folder, **path).returncode
        assert again == (2 if old == at else 0), again
    write_schedule(folder, schedule=SCHEDULE | named | {"description": "changed"})
    assert hil("reidentify", "weekly.yaml", cwd=folder, **path).returncode == 3
    return (
        "a schedule, a series and a fleet that do not name robot and address end with code 2, "
        "unconfirmed with 3, before anything moves; armed, the schedule runs and records it; "
        "another address (2) or a changed file (3) stops it again"
    )


@finding("A2d", "confirmation in the dashboard")
def confirmed_in_the_dashboard(folder: Path) -> str:
    """Start a run of an arm at a real address, and go on with it at another, with its name only."""
    from types import SimpleNamespace
    from unittest import mock

    from starlette.testclient import TestClient

    from hil.api import load, run
    from hil.dashboard import plan_preview, run_page, start_page
    from hil.dashboard.server import create_app
    from hil.dashboard.settings import Settings
    from hil.robot import Address
    from hil.workflow.motion_confirmation import Granted
    from hil.workflow.operator import console_channel
    from hil_mock_robot.embedded.robot import MockRobot

    (folder / "a.yaml").write_bytes((REPOSITORY / "experiments/ci_dwell_12.yaml").read_bytes())
    settings = Settings(runs=folder / "runs", registry=folder, specs=folder, port=8350)
    client = TestClient(create_app(settings), base_url="http://127.0.0.1:8350")
    started: list[dict[str, Any]] = []

    async def plan(asked: Any, gone: object) -> dict[str, Any]:
        return plan_preview._plan(asked)

    def start(*arguments: object, **more: Any) -> Any:
        started.append(more)
        return SimpleNamespace(id="1")

    def confirmed_at(page: str, **fields: str) -> dict[str, Any]:
        def post(**more: str) -> Any:
            form = {"csrf": settings.csrf} | fields | more
            return client.post(page, data=form, follow_redirects=False)

        before = len(started)
        bare = post()
        shown = dict(re.findall(r'name="(checked|facts)" value="([0-9a-f]{64})"', bare.text))
        unnamed = post(**shown)
        assert len(started) == before, "it was started without a confirmation"
        codes = [one.status_code for one in (bare, unnamed, post(confirm="ur5", **shown))]
        assert codes == [409, 409, 303], f"answers {codes}"
        facts: dict[str, Any] = started[-1]["confirmed"]
        return facts

    def stopped() -> Path:
        """A run of the arm that ended at a prompt which was answered with no."""
        (folder / "b.yaml").write_text(
            "hil: 1\nname: b\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 4}\n"
            "loads: [{mass_kg: 0}, {mass_kg: 1, com_m: [0, 0, 0.05], prompt: Mount it}]\n"
            "warm_up: {duration_s: 2}\nweigh: {poses: 0}\n"
        )
        (folder / "no.yaml").write_text("[{prompt: Mount it, answer: no}]\n")
        desk = console_channel(answers=folder / "no.yaml", confirm=Granted("--yes"))
        return run(load(folder / "b.yaml"), runs=folder / "runs", desk=desk).run

    at = Address("198.51.100.7")
    with (
        mock.patch.object(MockRobot, "address", at, create=True),
        mock.patch.object(plan_preview, "plan_in_process", plan),
        mock.patch.object(start_page, "start_run", start),
        mock.patch.object(run_page, "go_on_with", start),
    ):
        facts = confirmed_at("/start", spec="a.yaml", do="start")
        go_on = f"/runs/{stopped().relative_to(folder / 'runs').as_posix()}/go-on"
        same = client.post(go_on, data={"csrf": settings.csrf}, follow_redirects=False)
        assert (same.status_code, started[-1]["confirmed"]) == (303, None), same.text
        MockRobot.address = Address("198.51.100.8")  # type: ignore[attr-defined]
        left = confirmed_at(go_on)
    assert (facts["address"], left["address"]) == (at.text, "198.51.100.8")
    return (
        f"Start alone and without the name are refused (409) and show the facts; with it the run "
        f"of {facts['robot']} at {facts['address']} starts, with {len(facts)} confirmed facts; "
        f"Resume asks nothing there, and at {left['address']} the same as Start, for the "
        f"{left['swept']['duration_s']:.0f} s that are left"
    )


@finding("A2j", "way back of a jogged arm")
def jogged_arms_are_confirmed_again(folder: Path) -> str:
    """Go on with a run of a confirmed arm that stands elsewhere, without and with its name."""
    from unittest import mock

    from hil.api import load, resume, run
    from hil.core.errors import NotConfirmed
    from hil.robot import Address
    from hil.workflow.motion_confirmation import Granted
    from hil.workflow.operator import console_channel
    from hil_mock_robot.embedded.robot import MockRobot

    (folder / "b.yaml").write_text(
        "hil: 1\nname: b\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 4}\n"
        "loads: [{mass_kg: 0}, {mass_kg: 1, com_m: [0, 0, 0.05], prompt: Mount it}]\n"
        "warm_up: {duration_s: 2}\nweigh: {poses: 0}\n"
    )
    (folder / "station.yaml").write_text(
        "hil_station: 1\nrobots:\n  ur5: {driver: mock, model: ur5}\n"
    )
    (folder / "no.yaml").write_text("[{prompt: Mount it, answer: no}]\n")
    desk = console_channel(answers=folder / "no.yaml", confirm=Granted("--yes"))
    with mock.patch.object(MockRobot, "address", Address("198.51.100.7"), create=True):
        stopped = run(load(folder / "b.yaml"), runs=folder / "runs", desk=desk).run
        station = (stopped / "station.yaml").read_text("utf-8")
        elsewhere = "model: ur5, options: {start_q_deg: [-170, -60, -100, -60, 120, 170]}"
        (stopped / "station.yaml").write_text(station.replace("model: ur5", elsewhere))
        try:
            resume(stopped)
        except NotConfirmed as error:
            refused = error.message
        else:
            raise AssertionError("the jogged arm went back without a confirmation")
        assert not (stopped / "resume-01.json").exists(), "it began an attempt"
        resume(stopped, robot="ur5", desk=desk)
    assert (stopped / "resume-01.json").exists()
    return f"refused before it moved: {refused}; with robot='ur5' it goes on"


@finding("A2w", "series of a real robot in the dashboard")
def series_are_confirmed_step_by_step(folder: Path) -> str:
    """Compare a step of a series that carries and sweeps more with what its form has shown."""
    from hil.core.errors import NotConfirmed
    from hil.planning.experiment import load as load_experiment
    from hil.workflow.motion_confirmation import Granted, facts_of_all, motion_facts
    from hil.workflow.preview import planned

    shown = []
    for name, mass in (("a", 0.0), ("b", 1.0)):
        (folder / f"{name}.yaml").write_text(
            f"hil: 1\nname: {name}\nrobot: ur5\nexcitation: {{kind: dwell, waypoints: 4}}\n"
            f"loads: [{{mass_kg: {mass}, com_m: [0, 0, 0.05]}}]\nweigh: {{poses: 0}}\n"
        )
        experiment = load_experiment(folder / f"{name}.yaml")
        with planned(experiment) as (robot, plan, _):
            shown.append(motion_facts(experiment, robot, plan))
    granted = Granted("dashboard", "ada", facts_of_all([one.to_dict() for one in shown]))
    for one in shown:
        granted(one, lambda: None)
    heavy = replace(
        shown[1],
        loads=(replace(shown[1].loads[0], payload=replace(shown[1].loads[0].payload, mass=20.0)),),
        swept=replace(shown[1].swept, q_max=shown[1].swept.q_max + 6.0),
    )
    try:
        granted(heavy, lambda: None)
    except NotConfirmed as error:
        return f"both steps as shown are accepted; {error.message[:140]} …"
    raise AssertionError("a step with 20 kg and 6 rad more passed for what was shown")


# ---- A3 programs that must fail -----------------------------------------------------------------

SIX_POSES = """\
hil: 1
name: six
robot: ur5
excitation: {kind: dwell, waypoints: 6}
weigh: false
warm_up: {duration_s: 0}
fit: [{estimator: static-wls}]
"""


@finding("A3", "programs that must fail")
def programs_that_must_fail(folder: Path) -> str:
    """Six poses planned, ran to the end, and then "10 dwells are too few"."""
    spec = folder / "six.yaml"
    spec.write_text(SIX_POSES, "utf-8")

    def refused(words: str, *arguments: object) -> str:
        done = hil(*arguments, cwd=folder)
        line = done.stderr.partition("SpecError: ")[2].partition("\n")[0]
        assert done.returncode == 2, (arguments, done.returncode, done.stderr)
        assert words in line, (arguments, done.stderr)
        return line

    for verb in ("validate", "plan", "run"):
        line = refused("10 dwells are too few: at least 16", verb, spec)
    assert sorted(path.name for path in folder.iterdir()) == ["six.yaml"], "something was written"
    done = hil("run", spec, "--limit", 2, "--json", cwd=folder)
    assert done.returncode == 0, f"a commissioning run is refused: {done.stderr}"

    arm = (REPOSITORY / "hil" / "arms" / "ur5.yaml").read_text("utf-8")
    unknown = re.sub(r"drive_gain_nm_a: [0-9.]+", "drive_gain_nm_a: .nan", arm)
    (folder / "arm.yaml").write_text(unknown, "utf-8")
    station = folder / "bench.yaml"
    robot = "{driver: mock, model: arm.yaml}"
    station.write_text(f"hil_station: 1\nname: bench\nrobots: {{ur5: {robot}}}\n", "utf-8")
    enough = ("--set", "excitation.waypoints=12")
    refused("needs torques: drive gains", "validate", spec, "--station", station, *enough)
    of_file = ("--set", "excitation.file=poses.csv")
    refused("there is no file", "validate", spec, *of_file)
    poses = [f"{angle},-90,90,-90,-90,0" for angle in range(-60, 60, 10)]
    (folder / "poses.csv").write_text("q1,q2,q3,q4,q5,q6\n" + "\n".join(poses), "utf-8")
    done = hil("validate", spec, *of_file, cwd=folder)
    assert done.returncode == 0, f"q1 to q6 are refused: {done.stderr}"
    (folder / "poses.csv").write_text("\n".join([*poses, "0,-900,90,-90,-90,0"]), "utf-8")
    refused("poses.csv:13: shoulder_lift_joint at -900.0°", "validate", spec, *of_file)
    share = "validate={hold_out: {trajectories_percent: 25}}"
    program = "excitation={kind: fourier, trajectories: 8}"
    fit = ("--set", "fit.0.estimator=rigid-wls")
    done = hil("validate", spec, "--set", program, "--set", share, *fit, cwd=folder)
    assert done.returncode == 0, f"trajectories_percent is refused: {done.stderr}"
    message = line.partition("fit.0.estimator: ")[2]
    return (
        f"validate, plan and run end with 2 and no run directory ({message}); missing drive "
        "gains, a missing file of poses and a pose beyond its range are refused; q1…q6 and "
        "trajectories_percent are accepted"
    )


# ---- A4 workspace -------------------------------------------------------------------------------


@finding("A4", "workspace")
def workspace(folder: Path) -> str:
    page = (REPOSITORY / "docs/tutorial/first-real-ur5.md").read_text("utf-8")
    files = dict(re.findall(r"<!-- file: (\S+) -->\n```yaml\n(.*?)```", page, re.S))
    shelf = "      boxes:\n        - {name: shelf"
    assert shelf in files["station.yaml"], "the station of the tutorial has no shelf any more"
    bare = re.sub(r"      boxes:\n        - \{name: shelf.*\n", "", files["station.yaml"])
    small = re.sub(
        r"min_m: .*, max_m: .*\]",
        "min_m: [0.3, 0, 0.3], max_m: [0.5, 0.2, 0.5]",
        files["first.yaml"],
    )
    for name, text in (files | {"bare.yaml": bare, "small.yaml": small}).items():
        (folder / name).write_text(text)
    said = []
    for name, station in (("on a bare table", "bare.yaml"), ("with the shelf", "station.yaml")):
        plan = hil("plan", "first.yaml", "--station", station, "--json", cwd=folder)
        assert plan.returncode == 0, last_line(plan.stderr)
        margins = json.loads(plan.stdout)["margins"]
        distances = {key: 1e3 * margins[key] for key in ("clearance_m", "workspace_m")}
        assert min(distances.values()) >= 50.0, f"{name}: {distances}"
        said.append(
            name + " {clearance_m:.0f} mm clear and {workspace_m:.0f} mm inside".format(**distances)
        )
    began = time.monotonic()
    refused = hil("plan", "small.yaml", "--station", "bare.yaml", cwd=folder)
    took_s = time.monotonic() - began
    assert refused.returncode == 2, f"exit {refused.returncode} in a box of 0.2 m"
    assert re.search(r"\d mm (beyond|inside) [xyz] of (min|max)_m", refused.stderr), refused.stderr
    return f"plans {', '.join(said)}; a box of 0.2 m is refused in {took_s:.1f} s: " + next(
        line for line in refused.stderr.splitlines() if "mm" in line
    )


# ---- B1 registry log ----------------------------------------------------------------------------


@finding("B1", "registry log")
def registry_log(folder: Path) -> str:
    """Damage a log in five ways: each is named, blocks promotion, and is undone by `repair`."""
    from hil.estimators import estimator
    from hil.models.model_registry import Registry
    from tests.support.synthetic_motion import moving, nominal

    registry = Registry(folder / "whole")
    for number, seed in ((1, 3), (2, 4)):
        model = estimator("rigid-wls").fit(moving(1, 2, seed), nominal()).save(folder / f"{seed}")
        registry.register("ur5", model, {})
        registry.promote("ur5", number, reason="", evidence={}, instead_of=number - 1)
    log = (registry.root / "ur5" / "log.jsonl").read_bytes()
    lines = log.splitlines(keepends=True)
    damages = {
        "emptied": b"",
        "last line deleted": b"".join(lines[:-1]),
        "last line edited": log[: -len(lines[-1])] + lines[-1].replace(b"promoted", b"kept"),
        "cut inside a line": log[:-30],
        "removed": None,
    }
    for what, content in damages.items():
        home = folder / what.replace(" ", "-")
        shutil.copytree(registry.root, home)
        path, view = home / "ur5" / "log.jsonl", home / "ur5" / "aliases.json"
        path.unlink() if content is None else path.write_bytes(content)
        before = view.read_bytes()
        check = hil("models", "check", "--registry", home, cwd=folder)
        assert check.returncode == 11, f"{what}: check says {check.stdout}"
        assert "log.jsonl" in check.stderr, check.stderr
        assert "hil models repair" in check.stderr, check.stderr
        promoted = hil("models", "promote", "ur5", "v1", "--registry", home, cwd=folder)
        assert promoted.returncode == 11, f"{what}: promoted without comparison"
        assert view.read_bytes() == before, f"{what}: aliases.json was rewritten"
        repaired = hil("models", "repair", "ur5", "--registry", home, cwd=folder)
        assert "champion v2" in repaired.stdout, repaired.stdout + repaired.stderr
        assert hil("models", "check", "--registry", home, cwd=folder).returncode == 0
    home = Path(shutil.copytree(registry.root, folder / "lost"))
    shutil.rmtree(home / "ur5" / "v0002")
    check = hil("models", "check", "--registry", home, cwd=folder)
    assert check.returncode == 11, f"champion's folder deleted: check says {check.stdout}"
    assert "v0002 (champion)" in check.stderr, check.stderr
    repaired = hil("models", "repair", "ur5", "--registry", home, cwd=folder)
    assert "no champion" in repaired.stdout, repaired.stdout + repaired.stderr
    model = estimator("rigid-wls").fit(moving(1, 2, 5), nominal()).save(folder / "5")
    number = Registry(home).register("ur5", model, {}).number
    assert number == 3, f"the next model is v{number}"
    return (
        f"{len(damages)} damages ({', '.join(damages)}): `models check` and `promote` exit 11 and "
        "write nothing, `models repair` brings champion v2 back; with the folder of champion v2 "
        f"deleted `check` exits 11, a repair leaves no champion, and the next model is v{number}"
    )


# ---- B2 code from a git configuration -----------------------------------------------------------


@finding("B2", "code from a git configuration")
def code_from_git(folder: Path) -> str:
    """Run a spec in repositories that would each run a program; none may leave its mark."""
    from hil.recording.provenance import git_state
    from tests.support.git_parts import TRAPS, program, repository_with

    for number, (name, trap) in enumerate(TRAPS.items()):
        home = folder / str(number)
        home.mkdir()
        path, mark = program(home)
        specs = home / "specs"
        specs.mkdir()
        repository_with(specs, "a.yaml")
        trap(specs, str(path))
        mark.unlink(missing_ok=True)
        assert git_state(specs), name
        assert not mark.exists(), f"{name}: a program of the repository was run"
    specs = folder / "all"
    specs.mkdir()
    path, mark = program(folder)
    sha = repository_with(specs, "a.yaml")
    for name in ("file system monitor", "hooks", "pager", "include", "alias", "filter process"):
        TRAPS[name](specs, str(path))
    mark.unlink(missing_ok=True)
    shutil.copy(REPOSITORY / "experiments" / "ci_dwell_12.yaml", specs / "a.yaml")
    done = hil("run", "a.yaml", cwd=specs)
    assert done.returncode == 0, done.stderr
    assert not mark.exists(), "hil run ran a program of the repository"
    (start,) = specs.glob("runs/*/*/*/start.json")
    git = json.loads(start.read_text())["spec_git"]
    assert git == {"sha": sha, "dirty": None}, git
    return (
        f"{len(TRAPS)} ways to have git run a program, and `hil run` with six of them at once: "
        f"none was run; recorded are commit {sha[:7]} and, for a changed filtered file, no `dirty`"
    )


# ---- B3 names that are not UTF-8 ----------------------------------------------------------------


@finding("B3", "names that are not UTF-8")
def odd_names(folder: Path) -> str:
    """Run and list a spec, a folder of runs and a run whose names have a byte 0xff."""
    from starlette.testclient import TestClient

    from hil.dashboard.server import create_app
    from hil.dashboard.settings import Settings

    spec, runs = folder / os.fsdecode(b"d\xff.yaml"), folder / os.fsdecode(b"runs-\xff")
    spec.write_bytes((REPOSITORY / "experiments" / "ci_dwell_12.yaml").read_bytes())
    ended = hil("run", spec, "--runs", runs, "--operator", "ada", cwd=folder)
    assert ended.returncode == 0, f"hil run: {last_line(ended.stderr)}"
    (run,) = runs.glob("*/*/0*")
    assert (run / "report.html").is_file(), "no report"
    run = run.rename(run.with_name(os.fsdecode(b"0001-\xff")))
    for verb in (["show", run], ["runs", "--runs", runs], ["validate", spec]):
        said = json.loads(hil(*verb, "--json", cwd=folder).stdout)
        assert verb[0] != "show" or Path(said["run"]) == run, f"{verb[0]} --json names another run"
    settings = Settings(runs=runs, registry=folder / "registry", specs=folder, port=8350)
    client = TestClient(create_app(settings), base_url="http://127.0.0.1:8350")
    where = f"/runs/{quote(os.fsencode(run.relative_to(runs)))}"
    pages = ["/", "/runs", "/start", "/models", "/schedules", "/fleets", where, f"{where}/report"]
    wrong = {page: code for page in pages if (code := client.get(page).status_code) != 200}
    assert not wrong, f"pages that fail: {wrong}"
    return f"the run has its report, --json its name, and all {len(pages)} pages answer 200"


# ---- B4 speed slider ----------------------------------------------------------------------------


@finding("B4", "speed slider")
def _slider_lowered(folder: Path) -> str:
    import rtde_io

    address = "127.0.0.92"
    station = REPOSITORY / "experiments" / "stations" / "ur5_rtde_mock.yaml"
    text = station.read_text("utf-8").replace("127.0.0.1", address)
    (folder / "station.yaml").write_text(text, "utf-8")
    spec = REPOSITORY / "experiments" / "ci_dwell_12.yaml"
    with mock_ur("--speed", "4", journal=folder / "journal.jsonl", address=address):
        less = ("--set", "fit=[]", "--set", "accept={}", "--set", "warm_up.duration_s=0")
        asked = ("run", spec, "--station", "station.yaml", "--runs", "runs", *less)
        run = hil_in_background(*asked, cwd=folder)
        wait_for(lambda: '"movej"' in (folder / "journal.jsonl").read_text(), "a first move")
        slider = rtde_io.RTDEIOInterface(address)
        try:
            assert slider.setSpeedSlider(0.7)
            (run_at,) = wait_for(lambda: list((folder / "runs").glob("*/*/0*")), "the run's folder")
            log = run_at / "events.jsonl"
            wait_for(lambda: '"paused"' in log.read_text(), "a pause", 60.0)
            assert slider.setSpeedSlider(1.0)
        finally:
            slider.disconnect()  # its thread aborts this process when the controller goes first
        run.communicate(timeout=300.0)
        stop = json.loads((run_at / "stop.json").read_text())
        resumed = hil("resume", run_at, cwd=folder)
    shares = [
        event["share"]
        for event in map(json.loads, log.read_text().splitlines())
        if event["kind"] == "speed_scaling"
    ]
    assert run.returncode == 7, f"exit {run.returncode}: {stop['reason']}"
    assert "slower than planned" in stop["reason"], stop["reason"]
    assert shares == [0.7, 1.0], f"events {shares}"
    page = (run_at / "report.html").read_text("utf-8")
    assert "speed slider" in page, "the report says nothing"
    assert resumed.returncode == 0, last_line(resumed.stderr)
    return f"paused, exit 7, {stop['reason']!r}, events {shares}; hil resume: exit 0"


# ---- B5 suspended process -----------------------------------------------------------------------


@finding("B5", "suspended process")
def _suspended(folder: Path) -> str:
    wall = REPOSITORY / "experiments" / "stations" / "mock_wall.yaml"
    rtde = REPOSITORY / "experiments" / "stations" / "ur5_rtde_mock.yaml"
    (folder / "wall.yaml").write_text(wall.read_text("utf-8"), "utf-8")
    (folder / "rtde.yaml").write_text(rtde.read_text("utf-8").replace("127.0.0.1", "127.0.0.94"))
    ends = {}
    with mock_ur(address="127.0.0.94"):
        for station in ("wall", "rtde"):
            ends[station] = _stopped_and_continued(folder, f"{station}.yaml", f"runs-{station}")
    for station, (code, reason) in ends.items():
        assert code == 5, f"{station}: exit {code}, {reason}"
        assert "this process did not run for 10." in reason, f"{station}: {reason}"
    return f"exit 5 on the embedded mock and on UR: {ends['rtde'][1]!r}"


def _stopped_and_continued(folder: Path, station: str, runs: str) -> tuple[int, str]:
    spec = REPOSITORY / "experiments" / "ci_fourier_2.yaml"
    less = ("--set", "fit=[]", "--set", "accept={}")
    asked = ("run", spec, "--station", station, "--runs", runs, *less)
    run = hil_in_background(*asked, cwd=folder)
    (run_at,) = wait_for(lambda: list((folder / runs).glob("*/*/0*")), "the run's folder")
    log = run_at / "events.jsonl"
    wait_for(lambda: '"checkpoint", "step": 2' in log.read_text(), "a third step")
    run.send_signal(signal.SIGSTOP)
    time.sleep(10.0)
    run.send_signal(signal.SIGCONT)
    run.communicate(timeout=60.0)
    return run.returncode, json.loads((run_at / "stop.json").read_text())["reason"]


# ---- B6 killed between verdict and report -------------------------------------------------------


SMALL_SPEC = """hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 12, seed: 3}
warm_up: {duration_s: 2}
reference: {every: 0}
accept: {rmse: {max: 0.01, unit: A, per: joint}}
fit: [{estimator: static-wls}]
"""

KILLED_IN = """import os, signal, sys
from hil.cli import main
import {module} as module
owner = {owner}
owner.{name} = lambda *arguments, **options: os.kill(os.getpid(), signal.SIGKILL)
sys.argv[0] = "hil"
main()
"""
"""Kills the process at a call, in place of it."""


def killed_at(call: str, *arguments: object, cwd: Path, of: str = "module") -> None:
    """Run the command line in a process that is killed at a call, `module:name`."""
    module, name = call.split(":")
    code = KILLED_IN.format(module=module, owner=of, name=name)
    killed = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
    assert killed.returncode == -9, f"{call}: exit {killed.returncode}: {killed.stderr[-500:]}"


def small_spec(folder: Path) -> Path:
    """Write an experiment that takes seconds."""
    spec = folder / "small.yaml"
    spec.write_text(SMALL_SPEC)
    return spec


@finding("B6", "killed between verdict and report")
def killed_before_report(folder: Path) -> str:
    killed_at("hil.report:render_report", "run", small_spec(folder), cwd=folder)
    (run,) = folder.glob("runs/*/*/0001-small")
    assert (run / "verdict.json").is_file()
    assert not (run / "report.html").exists()
    (listed,) = json.loads(hil("runs", "--json", cwd=folder).stdout)
    assert listed["next"].startswith("hil resume "), listed
    resumed = hil(*listed["next"].split()[1:], cwd=folder)
    assert resumed.returncode == 10, f"exit {resumed.returncode}: {resumed.stderr}"
    assert (run / "report.html").is_file()
    return "hil runs names hil resume, which writes the report and exits 10, as the verdict says"


# ---- B7 reserve ---------------------------------------------------------------------------------


@finding("B7", "reserve")
def reserve_left(folder: Path) -> str:
    write_stop = "hil.recording.run_directory:write_stop"
    spec = small_spec(folder)
    killed_at(write_stop, "run", spec, cwd=folder, of="module.RunDirectory")
    killed_at(write_stop, "run", spec, cwd=folder, of="module.RunDirectory")
    first, second = sorted(folder.glob("runs/*/*/*-small"))
    assert (first / ".reserve").stat().st_size == 1 << 20
    assert hil("resume", 1, cwd=folder).returncode == 10
    assert not (first / ".reserve").exists(), "it stays after resume"
    assert hil("recover", 2, cwd=folder).returncode == 0
    assert not (second / ".reserve").exists(), "it stays after recover"
    return "the 1 MiB of a run that was killed before stop.json goes with hil resume and recover"


# ---- B8 killed before start.json ----------------------------------------------------------------


@finding("B8", "killed before start.json")
def killed_before_start(folder: Path) -> str:
    spec = small_spec(folder)
    start = "hil.recording.run_directory:write_start"
    killed_at(start, "run", spec, cwd=folder, of="module.RunDirectory")
    assert len(list(folder.glob("runs/*/*/.draft-*/plan.json"))) == 1
    listed = json.loads(hil("runs", "--json", cwd=folder).stdout)
    assert listed == [], listed
    assert hil("run", spec, cwd=folder).returncode == 10
    left = [*folder.glob("runs/.claim-*"), *folder.glob("runs/*/*/.draft-*")]
    assert not left, "the next run left it"
    names = [path.name for path in folder.glob("runs/*/*/*")]
    assert names == ["0001-small"], names
    disk = (
        "import shutil, sys\n"
        "full = shutil._ntuple_diskusage(10**9, 10**9 - 500_000, 500_000)\n"
        "shutil.disk_usage = lambda path: full\n"
        "from hil.cli import main\nsys.argv[0] = 'hil'\nmain()"
    )
    full = subprocess.run(
        [sys.executable, "-c", disk, "run", str(spec), "--runs", "elsewhere"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert full.returncode == 3, f"exit {full.returncode}: {full.stderr}"
    assert not (folder / "elsewhere").exists()
    return "no folder is listed, the next run removes the rest; a full disk fails preflight, exit 3"


# ---- B9 attacks on the dashboard ----------------------------------------------------------------


@finding("B9", "attacks on the dashboard")
def attacks(folder: Path) -> str:
    """Upgrade, abort 200 POSTs, keep 500 slow connections open, and ask for a page meanwhile."""
    log = folder / "serve.log"
    command = [sys.executable, "-m", "hil", "serve", "--port", "0"]
    with (
        log.open("wb") as errors,
        subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=errors) as serving,
        contextlib.ExitStack() as open_,
    ):
        try:
            assert serving.stdout is not None
            place = serving.stdout.readline().decode().split("//")[1].split("/")[0]
            host, port = place.split(":")

            def ask(text: str) -> socket.socket:
                made = socket.create_connection((host, int(port)), 30)
                made.sendall(text.replace("PLACE", place).encode())
                return made

            upgrade = "Connection: upgrade\r\nUpgrade: websocket\r\n\r\n"
            with ask(f"GET / HTTP/1.1\r\nHost: evil.example\r\n{upgrade}") as one:
                foreign = one.recv(4096)[9:12].decode()
            with ask(f"GET / HTTP/1.1\r\nHost: PLACE\r\n{upgrade}") as one:
                upgraded = one.recv(4096)[9:12].decode()
            assert (foreign, upgraded) == ("421", "400"), f"an upgrade: {foreign}, {upgraded}"
            for _ in range(200):
                ask("POST /who HTTP/1.1\r\nHost: PLACE\r\nContent-Length: 9\r\n\r\ncs").close()
            slow = [open_.enter_context(ask("POST / HTTP/1.1\r\nHost: PL")) for _ in range(500)]
            began = time.monotonic()
            with ask("GET / HTTP/1.1\r\nHost: PLACE\r\nConnection: close\r\n\r\n") as one:
                assert one.recv(4096)[9:12] == b"200", "a page does not come"
            took = time.monotonic() - began
            for one in slow:  # each ends, or this times out
                with contextlib.suppress(ConnectionError):
                    while one.recv(4096):
                        pass
            ended = time.monotonic() - began
        finally:
            serving.kill()
    lines = log.read_text().splitlines()
    assert len(lines) < 20, f"{len(lines)} lines of log, {last_line(log.read_text())}"
    return (
        f"an upgrade is {upgraded}, of another host {foreign}; 200 aborted POSTs and 500 slow "
        f"connections leave {len(lines)} lines of log; a page came in {took:.2f} s, and the last "
        f"slow connection was closed after {ended:.0f} s"
    )


# ---- B10 YAML aliases ---------------------------------------------------------------------------


@finding("B10", "YAML aliases")
def yaml_aliases(folder: Path) -> str:
    lines = ["a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    bomb = folder / "bomb.yaml"
    bomb.write_text("\n".join(lines))
    measure = (
        "import time, tracemalloc, sys; from hil.spec.load import load_spec\n"
        "def read():\n    try: load_spec(sys.argv[1])\n    except Exception as e: return str(e)\n"
        "read(); begin = time.process_time(); read(); spent = time.process_time() - begin\n"
        "tracemalloc.start(); read(); print(spent * 1e3, tracemalloc.get_traced_memory()[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", measure, str(bomb)], capture_output=True, text=True, check=True
    )
    cpu_ms, peak = done.stdout.split()
    assert float(cpu_ms) <= 50, f"{cpu_ms} ms"
    assert int(peak) <= 10e6, f"{peak} bytes"
    validated = hil("validate", bomb, cwd=folder)
    assert validated.returncode == 2, validated.stderr
    assert "aliases expand" in validated.stderr, validated.stderr
    size = bomb.stat().st_size
    return f"{size} bytes are refused in {float(cpu_ms):.1f} ms and {int(peak) / 1e6:.2f} MB"


# ---- B11 mock UR controller behind the wall clock -----------------------------------------------


@finding("B11", "mock UR controller behind the wall clock")
def _mock_behind(folder: Path) -> str:
    journal, address = folder / "journal.jsonl", "127.0.0.91"
    mock = subprocess.Popen(
        [sys.executable, "-m", "hil", "mock", "ur", "--address", address, "--journal", journal],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert mock.stdout is not None
        assert "ready" in mock.stdout.readline()
        for _ in range(4):  # it gets 0.2 s of every 2.2 s, as on a computer that is too busy
            mock.send_signal(signal.SIGSTOP)
            time.sleep(2.0)
            mock.send_signal(signal.SIGCONT)
            time.sleep(0.2)
        asked = ("mock", "ur", "send", "--address", address, "state")
        state = json.loads(hil(*asked, cwd=folder).stdout)
    finally:
        mock.terminate()
        _, said = mock.communicate(timeout=20.0)
    slips = [line for line in journal.read_text().splitlines() if '"slip"' in line]
    lines = [line for line in said.splitlines() if "behind the wall clock" in line]
    assert state["behind_s"] > 6.0, f"behind_s {state['behind_s']}"
    assert len(slips) >= 4, f"{len(slips)} slips in the journal"
    assert len(lines) == 1, f"{len(lines)} lines on its console"
    return (
        f"behind_s {state['behind_s']:.1f} and pace {state['pace']:.2f} on the side channel, "
        f"{len(slips)} slips in the journal, {len(lines)} line on the console: {lines[0]!r}"
    )


# ---- B12 single bag file ------------------------------------------------------------------------

BAG_MAP = """\
hil_map: 1
format: ros2bag
robot: three-link
joint_names: [base, shoulder, elbow]
effort_kind: torque
topic: /joint_states
columns: {q: {unit: rad}, qd: {unit: rad/s}, effort: {unit: N·m}}
"""


@finding("B12", "single bag file")
def single_bag_file(folder: Path) -> str:
    from tests.importers.test_formats import bag

    (file,) = bag(folder).glob("*.db3")
    file.rename(folder / "run.db3")
    (folder / "map.yaml").write_text(BAG_MAP, "utf-8")
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {relative_file_paths: [another.db3]}\n", "utf-8"
    )
    done = hil("import", "run.db3", "--map", "map.yaml", "-o", "out.mcap", cwd=folder)
    assert done.returncode == 0, done.stderr
    return f"beside the metadata.yaml of another bag: {' '.join(done.stdout.split())}"


# ---- B13 rest pose of the recommended model -----------------------------------------------------


@finding("B13", "rest pose of the recommended model")
def rest_pose_with_memory(folder: Path) -> str:
    done = hil("run", REPOSITORY / "experiments/ci_fourier_2.yaml", "--runs", "runs", cwd=folder)
    assert done.returncode == 0, done.stderr
    (run,) = (folder / "runs").glob("*/ur5/*")
    done = hil("fit", run, "-e", "rigid-hysteresis", cwd=folder)
    assert done.returncode == 0, done.stderr
    (model,) = (folder / "models").glob("rigid-hysteresis-*")
    done = hil("rest-pose", model, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    held = report["dry_friction_nm"]
    assert held is not None, report["notes"]
    assert min(held) > 0.0, held
    assert not any("friction" in note and "known" in note for note in report["notes"])
    return f"its joints hold {', '.join(f'{level:.1f}' for level in held)} N·m by friction"


def main(numbers: list[str]) -> int:
    """Repeat the entries with these numbers, or all, and return the exit code."""
    if unknown := [number for number in numbers if number not in FINDINGS]:
        print(f"no such entry: {', '.join(unknown)}; there are {', '.join(FINDINGS)}")
        return 2
    failures = 0
    for number, (title, function) in FINDINGS.items():
        if numbers and number not in numbers:
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="hil-finding-") as folder:
            line, ok = _repeat(function, Path(folder))
        failures += not ok
        print(f"{number:<4}{'ok ' if ok else 'BAD'}  {title}: {line}", end="")
        print(f"  [{time.monotonic() - began:.0f} s]", flush=True)
    print(f"{failures} of the defects are back" if failures else "none of the defects is back")
    return 1 if failures else 0


def _repeat(function: Finding, folder: Path) -> tuple[str, bool]:
    try:
        return function(folder), True
    except Exception as error:  # one entry must not hide the others
        where: Any = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} (line {where.lineno})", False


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
