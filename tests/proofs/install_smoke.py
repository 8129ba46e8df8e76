"""What an installed wheel must do with just these extras; run by `install_matrix.py`.

`python install_smoke.py core ur` in a virtual environment of its own and an empty folder: no
checkout and no pytest. It prints one line per check and exits 1 when one fails.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

BIN = Path(sys.executable).parent
PLUGIN_MISSING = 2
"""Exit code of a command whose extra is absent (docs/reference/cli.md)."""

GUARDED = """
import sys
from hil.core.errors import HilError
try:
    {need}
except HilError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
"""

JOINTS = 6
RATE_HZ = 100
ROWS = 1500

NEEDS = {
    "mock": "hil mock ur --help",
    "ur": "from hil_drivers.ur.control import _library; _library('rtde_control')",
    "can": "from hil_drivers.cia402.can_channel import CanChannel, open_bus; "
    "open_bus(CanChannel('virtual', 'smoke')).shutdown()",
    "ads": "from hil_drivers.twincat.ads import library; library()",
    "learn": "hil fit one.mcap -e lagrangian",
    "web": "hil serve --host nowhere.invalid",
}
"""What an extra is for. Without it, it ends with the words to type; `hil …` is a command."""

MAP = """\
hil_map: 1
format: csv
robot: ur5
joint_names: [shoulder_pan_joint, shoulder_lift_joint, elbow_joint,
              wrist_1_joint, wrist_2_joint, wrist_3_joint]
effort_kind: torque
columns:
  t: {rate_hz: 100}
  q: {columns: "1:6", unit: rad}
  effort: {columns: "7:12", unit: N·m}
"""


def hil(*arguments: str, code: int = 0) -> str:
    """Standard output of a command that must end with this exit code."""
    done = subprocess.run([str(BIN / "hil"), *arguments], capture_output=True, text=True)
    if done.returncode != code:
        raise AssertionError(f"hil {' '.join(arguments)}: {done.returncode}\n{done.stderr}")
    return done.stdout


def starts() -> str:
    """The package is the wheel's, and the command answers."""
    import hil as package

    where = Path(package.__file__).resolve()
    if "site-packages" not in where.parts:
        raise AssertionError(f"hil is not the installed one: {where}")
    hil("--help")
    return hil("--version").strip()


def doctor() -> str:
    """Nothing is bad, and what is missing is only noted."""
    document = json.loads(hil("doctor", "--json"))
    findings = document if isinstance(document, list) else document["findings"]
    if bad := [f for f in findings if f["level"] == "bad"]:
        raise AssertionError(str(bad))
    return f"{len(findings)} findings, none bad"


def identifies() -> str:
    """A CSV of another tool becomes a model, judged on another recording: no mock, no extra."""
    Path("map.yaml").write_text(MAP, "utf-8")
    for name, seed in (("one", 1), ("two", 2)):
        _write_motion(Path(f"{name}.csv"), seed)
        hil("import", f"{name}.csv", "--map", "map.yaml", "-o", f"{name}.mcap")
    told = hil("fit", "one.mcap", "-e", "rigid-wls", "--validate", "two.mcap", "--json")
    document = json.loads(told)
    error = max(document["validation"][0]["rmse_raw"])
    if error > 0.5:  # the motion costs tens of N·m, the noise is 0.1
        raise AssertionError(f"RMSE {error:.3f} N·m on the held-out recording")
    hil("export", document["model"], "-o", "exported", "--to", "c")
    return f"largest held-out RMSE {error:.3f} N·m; exported to C"


def _write_motion(file: Path, seed: int) -> None:
    """A UR5 that moves in sinusoids, with torque of its nominal body, friction and noise."""
    import numpy as np

    from hil.dynamics.robot_model import load_model

    model, rng = load_model("ur5"), np.random.default_rng(seed)
    t = np.arange(ROWS)[:, None, None] / RATE_HZ
    omega = 2 * np.pi * np.arange(1, 4) / 7.5
    amplitude = rng.uniform(0.1, 0.4, (JOINTS, 3))
    phase = rng.uniform(0, 2 * np.pi, (JOINTS, 3))
    angle = omega * t + phase
    q = (amplitude * np.sin(angle)).sum(-1) + np.array([0.0, -1.2, 1.0, 0.3, 0.5, 0.0])
    qd = (amplitude * omega * np.cos(angle)).sum(-1)
    qdd = -(amplitude * omega**2 * np.sin(angle)).sum(-1)
    torque = model.inverse_dynamics(q, qd, qdd) + 2.0 * np.tanh(qd / 0.01) + 3.0 * qd
    torque += 0.1 * rng.standard_normal(torque.shape)
    np.savetxt(file, np.column_stack([q, torque]), delimiter=",", fmt="%.9g")


def works(extra: str) -> str:
    """What an extra is for works, or comes as far as it can with no robot."""
    done = _use(extra)
    if "hil[" in done.stderr or "Traceback" in done.stderr:
        raise AssertionError(done.stderr[-2000:])
    if done.returncode and extra != "web":  # which has nowhere to serve
        raise AssertionError(done.stderr[-2000:])
    return NEEDS[extra]


def tells_what_is_missing(extra: str) -> str:
    """Without the extra one line says what to type, and there is no traceback."""
    done = _use(extra)
    said = [line for line in done.stderr.splitlines() if f"hil[{extra}]" in line]
    if done.returncode != PLUGIN_MISSING or not said or "Traceback" in done.stderr:
        raise AssertionError(f"{NEEDS[extra]}: {done.returncode}\n{done.stderr[-2000:]}")
    return said[0].strip()


def _use(extra: str) -> subprocess.CompletedProcess[str]:
    need = NEEDS[extra]
    if need.startswith("hil "):
        command = [str(BIN / "hil"), *need.split()[1:]]
    else:
        command = [sys.executable, "-c", GUARDED.format(need=need)]
    return subprocess.run(command, capture_output=True, text=True, timeout=180)


def checks(extras: list[str]) -> Iterator[tuple[str, Callable[[], str]]]:
    """What is looked at, in this order, with its name."""
    yield "starts", starts
    yield "doctor", doctor
    yield "csv → model → C", identifies
    for extra in NEEDS:
        have = extra in extras
        what = works if have else tells_what_is_missing
        yield f"{extra} {'works' if have else 'is asked for'}", lambda e=extra, w=what: w(e)


def main() -> int:
    """Run every check and tell each."""
    failed = 0
    for name, check in checks(sys.argv[1:]):
        try:
            told = f"ok   {name}: {check()}"
        except Exception as error:
            failed += 1
            told = f"FAIL {name}: {type(error).__name__}: {error}"
        sys.stdout.write(told + "\n")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
