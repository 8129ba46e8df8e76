"""Every command in the documentation exists as it stands there, and what can be run is run.

How a page asks for that is in docs_commands.py.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.support import docs_commands

BLOCKS = [block for page in docs_commands.PAGES for block in docs_commands.blocks(page)]
COMMANDS = [(block, line) for block in BLOCKS for line in block.commands]

SERVES = "serves until Ctrl-C, or asks one that does: the tests of the mocks and the driver do it"
SCRIPTS = (
    "tests/house/test_lab_scripts.py runs the scripts on the mock, proofs execute the notebooks"
)
HARDWARE = "needs a robot, or recordings, of the reader's own"
ELSEWHERE = "docs/tutorial/first-real-ur5.md has the same command, which is run there"
LONG = "minutes to hours, or a cluster: proofs with the same experiments do it"
BEGUN = "goes on with what is under way: tests of runs, registry and fleets do it"
INSTALLS = "writes into the environment or the shell of who calls it"

NOT_RUN = {
    "README.md": {INSTALLS: 2, LONG: 4},
    "docs/explanation/past-one-machine.md": {LONG: 1},
    "docs/gallery.md": {LONG: 15, SERVES: 1},
    "docs/how-to/calibrate-drive-gains.md": {HARDWARE: 1},
    "docs/how-to/drive-a-ur.md": {SERVES: 1, ELSEWHERE: 1, HARDWARE: 5},
    "docs/how-to/drive-can-drives.md": {SERVES: 3, HARDWARE: 1},
    "docs/how-to/drive-twincat.md": {SERVES: 5},
    "docs/how-to/export-onnx-mlp.md": {LONG: 1},
    "docs/how-to/identify-a-load.md": {HARDWARE: 6},
    "docs/how-to/import-your-data.md": {HARDWARE: 3},
    "docs/how-to/lab-scripts.md": {SCRIPTS: 4},
    "docs/how-to/re-identify-on-schedule.md": {SERVES: 4, HARDWARE: 1},
    "docs/how-to/record-a-program.md": {HARDWARE: 4},
    "docs/how-to/run-a-fleet.md": {LONG: 1, HARDWARE: 1},
    "docs/how-to/run-a-series.md": {LONG: 2},
    "docs/how-to/run-under-systemd.md": {BEGUN: 1},
    "docs/how-to/simulate-a-schedule.md": {LONG: 1},
    "docs/how-to/spread-fits.md": {LONG: 1},
    "docs/how-to/train-networks.md": {LONG: 2},
    "docs/how-to/use-the-dashboard.md": {SERVES: 3},
    "docs/how-to/watch-and-control-a-run.md": {BEGUN: 7},
    "docs/how-to/watch-for-drift.md": {LONG: 5},
    "docs/how-to/write-a-spec.md": {HARDWARE: 3},
    "docs/reference/estimators.md": {HARDWARE: 1},
    "docs/reference/installing.md": {INSTALLS: 1},
    "docs/reference/mock-can-faults.md": {SERVES: 4},
    "docs/reference/mock-can.md": {SERVES: 2},
    "docs/reference/mock-ur-faults.md": {SERVES: 4},
    "docs/reference/studies.md": {LONG: 8},
    "docs/tutorial/first-real-ur5.md": {SERVES: 1, HARDWARE: 7},
    "docs/tutorial/first-run.md": {INSTALLS: 1, SERVES: 1},
}
"""How many commands of a page are held against the parser only, and why."""


def pages_with(kind: str) -> list[str]:
    return sorted({block.page for block in BLOCKS if block.runs == kind})


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("block", "line"), COMMANDS, ids=[f"{b.page}:{b.line}:{n[:40]}" for b, n in COMMANDS]
)
def test_the_command_is_one(block: docs_commands.Block, line: str) -> None:
    docs_commands.parse(line)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("hil vaildate spec.yaml", "No such command 'vaildate'"),
        ("hil run spec.yaml --sped 10%", "No such option: --sped"),
        ("hil fit", "Missing parameter: sources"),
        ("hil models promot ur5", "No such command 'promot'"),
        ("hil run a.yaml b.yaml", "unexpected extra argument"),
        ("hil mock ur --sped 10", "invalid choice: '10'"),
        ("hil mock nobody", "no mock 'nobody'"),
        ("make dmeo", "no ['dmeo']"),
        (".venv/bin/hil dcotor", "No such command 'dcotor'"),
        ("python experiments/scripts/compare_arms.py a b --sped 1", "No such option: --sped"),
        ("python experiments/scripts/compare.py a b", "No such file"),
        ("python -m hil_drivers.cia402 rset station.yaml arm", "invalid choice"),
        ("jupyter execute experiments/notebooks/none.ipynb", "no such notebooks"),
    ],
)
def test_a_command_that_is_none_is_found(
    line: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises((Exception, SystemExit)) as found:
        docs_commands.parse(line)
    assert said in f"{found.value} {getattr(found.value, 'message', '')} {capsys.readouterr().err}"


def test_what_is_not_run_is_known_and_why() -> None:
    left = Counter(block.page for block, _ in COMMANDS if not block.runs)
    known = {page: sum(reasons.values()) for page, reasons in NOT_RUN.items()}
    assert known == left, "run them (docs_commands.py says how), or write here why not"


def test_a_page_sees_nothing_of_the_developer_and_leaves_nothing_with_him(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page that writes beside the specs, where somebody has runs, a registry and data."""
    root, work = tmp_path / "checkout", tmp_path / "work"
    for folder in (root / "experiments", work):
        folder.mkdir(parents=True)
    block = "<!-- run -->\n```sh\nenv > seen; touch experiments/made\n```\n"
    (root / "page.md").write_text(block, "utf-8")
    for name in ("RUNS", "REGISTRY", "STATION", "DATA", "LEASES", "CACHE"):
        monkeypatch.setenv(f"HIL_{name}", "/of/the/developer")
    monkeypatch.setattr(docs_commands, "ROOT", root)
    done = docs_commands.run_page("page.md", ("run",), work)
    assert done.returncode == 0, done.stderr
    seen = dict(row.partition("=")[::2] for row in (work / "seen").read_text("utf-8").splitlines())
    told = {key: value for key, value in seen.items() if key.startswith("HIL_")}
    assert told == {"HIL_LEASES": str(work / "leases"), "HIL_CACHE": str(work / "cache")}
    assert (work / "experiments" / "made").exists()
    assert not (root / "experiments" / "made").exists()


@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.parametrize("page", sorted({*pages_with("run")} - {*pages_with("run wire")}))
def test_the_page_runs(page: str, tmp_path: Path) -> None:
    done = docs_commands.run_page(page, ("run",), tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.wire
@pytest.mark.timeout(400)
@pytest.mark.parametrize("page", pages_with("run wire"))
def test_the_page_runs_over_sockets(page: str, tmp_path: Path) -> None:
    done = docs_commands.run_page(page, ("run", "run wire"), tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
