"""The proofs, one unit a claim: what is run for it, and about how long that takes.

A unit is stale when a file that it depends on has changed since it last passed: what all depend on
(`ALWAYS` of the runner: product, dependencies, experiments), its own test files with all that they
import of `tests`, and what it names besides.
"""

from __future__ import annotations

from dataclasses import dataclass

from tests.proofs import fuzz_long
from tests.support.paths import ROOT

PYTEST = ("-m", "pytest", "-p", "no:cacheprovider", "--timeout", "5400", "-s")


@dataclass(frozen=True)
class Unit:
    """A claim and the program that shows it.

    Args:
        name: As in `make proof UNIT=name`.
        claim: One sentence that the program may refute.
        run: Arguments of the Python interpreter.
        minutes: What to expect on two cores.
        further: Other files that it depends on, as patterns relative to the checkout.
    """

    name: str
    claim: str
    run: tuple[str, ...]
    minutes: float
    further: tuple[str, ...] = ()

    @property
    def tests(self) -> tuple[str, ...]:
        """The test files it runs."""
        return tuple(part.partition("::")[0] for part in self.run if part.startswith("tests/"))

    @property
    def modules(self) -> tuple[str, ...]:
        """The files of the modules of `tests` that it runs."""
        found = (part for part in self.run if part.startswith("tests."))
        return tuple(part.replace(".", "/") + ".py" for part in found)


def _tests(name: str, claim: str, *files: str, minutes: float, further: str = "") -> Unit:
    """Return a unit that runs the tests of some files that are marked as proofs."""
    run = (*PYTEST, "-m", "proof and not matrix", *files)
    return Unit(name, claim, run, minutes, tuple(further.split()))


def _matrix(name: str, claim: str, file: str, at_once: int) -> Unit:
    run = ("-m", "pytest", "-p", "no:cacheprovider", "-n", str(at_once), "-m", "matrix", file)
    return Unit(name, claim, run, minutes=10)


def _bench(name: str, claim: str, minutes: float) -> Unit:
    return Unit(f"bench-{name}", claim, ("-m", "hil", "bench", name), minutes)


UNITS = (
    _tests(
        "program",
        "the 650-pose program runs, fits and passes, 50 times faster than real time",
        "tests/proofs/test_mock.py",
        minutes=3,
    ),
    _tests(
        "static",
        "intervals of the static estimators hold the mock's truth as often as they say",
        "tests/proofs/test_static.py",
        minutes=6,
    ),
    _tests(
        "stick",
        "ours predicts friction at rest on held-out poses better than the paper's methods",
        "tests/proofs/test_stick_friction.py",
        minutes=8,
    ),
    _tests(
        "separation",
        "the static separation study orders the methods as the paper does, and ours first",
        "tests/proofs/test_separation.py",
        minutes=20,
    ),
    _tests(
        "inverse-dynamics",
        "every row of Table II of the network paper is computed, held-out and as printed",
        "tests/proofs/test_inverse_dynamics.py",
        minutes=2,
    ),
    _tests(
        "identification",
        "intervals of dynamic identification hold, and it beats its peers, on robots unseen before",
        "tests/proofs/test_identification.py",
        minutes=30,
    ),
    _tests(
        "networks",
        "the default network beats the paper's methods on mock robots unseen before",
        "tests/proofs/test_networks.py",
        minutes=30,
    ),
    _tests(
        "loads",
        "payload and gain estimates have the errors that they state",
        "tests/proofs/test_loads.py",
        "tests/estimators/test_payload.py",
        "tests/estimators/test_recorded_arm.py",
        minutes=6,
    ),
    _tests(
        "payload-check",
        "an undeclared load is found on every arm, and a declared one passes",
        "tests/workflow/test_weighing.py",
        minutes=10,
    ),
    _tests(
        "hand-guiding",
        "hand guiding takes at most half the force on arms that the filter was not tuned on",
        "tests/proofs/test_hand_guiding.py",
        "tests/control/test_try_out.py",
        "tests/frozen/test_frozen_documents.py",
        minutes=5,
    ),
    _tests(
        "recorder",
        "the recorder loses nothing at 500 Hz and costs little",
        "tests/proofs/test_recording.py",
        "tests/recording/test_recovery.py",
        minutes=5,
    ),
    _tests(
        "drift-null",
        "a thousand probes of unchanged robots raise at most the stated rate of alarms",
        "tests/proofs/test_drift_null.py",
        minutes=30,
    ),
    _tests(
        "null-campaigns",
        "a robot that never changes keeps its model through weekly identification",
        "tests/proofs/test_null_campaigns.py",
        minutes=8,
    ),
    _tests(
        "simulated-weeks",
        "twelve weeks of a wearing robot: the first probe sees it, one model is promoted",
        "tests/proofs/test_simulation.py",
        minutes=30,
    ),
    _tests(
        "schedule",
        "a schedule killed again and again does each occasion once",
        "tests/proofs/test_schedule.py",
        minutes=8,
    ),
    _tests(
        "pipeline-kill",
        "killed at more than sixty random points, a schedule ends as if undisturbed",
        "tests/proofs/test_pipeline_kill.py",
        minutes=30,
    ),
    _tests(
        "kill-runs",
        "whole runs, registrations and promotions killed at random lose nothing",
        "tests/proofs/test_kill_whole_runs.py",
        minutes=20,
    ),
    _tests(
        "fleet",
        "a hundred robots fitted by processes and by Dask give the same bits",
        "tests/proofs/test_fleet.py",
        minutes=10,
    ),
    _tests(
        "fleet-outliers",
        "of thirty simulated robots exactly the worn ones are reported as outliers",
        "tests/proofs/test_fleet_mock.py",
        minutes=30,
    ),
    _tests(
        "ur-programs",
        "whole programs on a mock UR5 through ur-rtde lose no sample and give the same models",
        "tests/proofs/test_ur.py",
        minutes=25,
    ),
    _tests(
        "tracing",
        "exported programs stream a model's efforts, and no number of a document may be wrong",
        "tests/export/test_conformance.py",
        "tests/export/test_json_columns.py",
        minutes=3,
    ),
    _tests(
        "wire",
        "drivers keep the contract of a robot over real sockets, at length",
        "tests/drivers/ur",
        "tests/drivers/twincat",
        "tests/robot/test_conformance.py",
        minutes=12,
    ),
    _matrix(
        "faults-embedded",
        "any fault at any kind of step stops the embedded arm in time",
        "tests/faults/test_embedded.py",
        2,
    ),
    _matrix(
        "faults-ur",
        "any fault of a UR controller at any kind of step stops the arm in time",
        "tests/faults/test_ur.py",
        2,
    ),
    _matrix(
        "faults-can",
        "any fault of drives or their bus at any kind of step stops all axes in time",
        "tests/faults/test_can.py",
        2,
    ),
    Unit(
        "fuzz",
        "thousands of damaged specs, stations, runs and recordings end in one clear error",
        ("-m", "tests.proofs.fuzz_long"),
        20,
        tuple(file.relative_to(ROOT).as_posix() for file in fuzz_long.files()),
    ),
    _tests(
        "docs",
        "the long commands of the documentation run as they stand there",
        "tests/proofs/test_docs.py",
        minutes=20,
        further="docs/**/*.md",
    ),
    _tests(
        "notebooks",
        "the notebooks run from beginning to end",
        "tests/proofs/test_notebooks.py",
        minutes=5,
        further="docs/**/*.ipynb examples/**/*",
    ),
    _tests(
        "example",
        "the example projects' own CI passes against the wheel",
        "tests/proofs/test_example.py",
        minutes=5,
        further="examples/**/*",
    ),
    _tests(
        "wheel",
        "the wheel works in fresh environments",
        "tests/proofs/test_wheels.py",
        minutes=5,
    ),
    Unit(
        "wheels",
        "the wheel works with each set of extras under each Python at hand",
        ("-m", "tests.proofs.install_matrix"),
        30,
    ),
    Unit(
        "soak",
        "a simulated day at 500 Hz through the recorder, nothing lost, memory flat",
        ("-m", "hil", "bench", "soak", "--hours", "24"),
        15,
    ),
    _tests(
        "lm",
        "Levenberg–Marquardt arrives sooner than its peers",
        "tests/bench/test_lm.py",
        minutes=12,
    ),
    _tests(
        "lagrangian",
        "the Lagrangian network's torque is several times quicker than its peer's",
        "tests/bench/test_lagrangian.py",
        minutes=8,
    ),
    _tests(
        "excitation",
        "the excitation optimiser finds better motions sooner than its peers",
        "tests/bench/test_excite.py",
        minutes=10,
    ),
    _tests(
        "can-cycle",
        "the CAN cycle leaves most of a core free",
        "tests/bench/test_can.py",
        minutes=3,
    ),
    _tests(
        "benches",
        "the benchmarks of starts and predictions time what they name, and its results agree",
        "tests/bench/test_predict.py",
        "tests/bench/test_startup.py",
        minutes=2,
    ),
    _bench("startup", "`hil --help` starts about as fast as an empty Python", 1),
    _bench("mcap", "MCAP is read and written faster than by the reference library", 3),
    _bench("rtde", "RTDE is read with less of a core than ur-rtde needs", 3),
    _bench("regressor", "the compiled regressor beats Pinocchio's", 2),
    _bench("collision", "distances along a path cost a fraction of a search", 2),
    _bench("predict", "a model predicts in a control cycle", 2),
    _bench("catalogue", "a thousand runs are listed in a fraction of a second", 3),
    _bench("interlocks", "judging every sample costs little", 2),
    _bench("crash", "recovery after kills keeps all that was flushed", 5),
    _bench("diffnea", "DiffNEA fits sooner than its peer", 5),
)
