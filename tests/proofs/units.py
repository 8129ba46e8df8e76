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


def _bench(name: str, claim: str, *bounds: str, minutes: float) -> Unit:
    run = ("-m", "tests.proofs.bench", name, *bounds)
    return Unit(f"bench-{name}", claim, run, minutes)


UNITS = (
    _tests(
        "program",
        "the 650-pose program runs, fits and passes, 50 times faster than real time",
        "tests/proofs/test_mock.py",
        minutes=5,
    ),
    _tests(
        "static",
        "intervals of the static estimators hold the mock's truth as often as they say",
        "tests/proofs/test_static.py",
        minutes=3,
    ),
    _tests(
        "stick",
        "ours predicts friction at rest on held-out poses better than the paper's methods",
        "tests/proofs/test_stick_friction.py",
        minutes=14,
    ),
    _tests(
        "separation",
        "the static separation study orders the methods as the paper does, and ours first",
        "tests/proofs/test_separation.py",
        minutes=15,
    ),
    _tests(
        "inverse-dynamics",
        "every row of Table II of the network paper is computed, held-out and as printed",
        "tests/proofs/test_inverse_dynamics.py",
        minutes=1,
    ),
    _tests(
        "identification",
        "intervals of dynamic identification hold, and it beats its peers, on robots unseen before",
        "tests/proofs/test_identification.py",
        minutes=22,
    ),
    _tests(
        "networks",
        "the default network beats the paper's methods on mock robots unseen before",
        "tests/proofs/test_networks.py",
        minutes=15,
    ),
    _tests(
        "loads",
        "payload and gain estimates have the errors that they state",
        "tests/proofs/test_loads.py",
        "tests/estimators/test_payload.py",
        "tests/estimators/test_recorded_arm.py",
        minutes=3,
    ),
    _tests(
        "payload-check",
        "an undeclared load is found on every arm, and a declared one passes",
        "tests/workflow/test_weighing.py",
        minutes=2,
    ),
    _tests(
        "hand-guiding",
        "hand guiding takes at most half the force on arms that the filter was not tuned on",
        "tests/proofs/test_hand_guiding.py",
        "tests/control/test_try_out.py",
        "tests/frozen/test_frozen_documents.py",
        minutes=8,
    ),
    _tests(
        "recorder",
        "the recorder loses nothing at 500 Hz, keeps its memory, and kills cost 0.25 s at most",
        "tests/proofs/test_recording.py",
        "tests/recording/test_recovery.py",
        minutes=2,
    ),
    _tests(
        "drift-null",
        "five hundred probes of unchanged robots raise at most the stated rate of alarms",
        "tests/proofs/test_drift_null.py",
        minutes=30,
    ),
    _tests(
        "null-campaigns",
        "a robot that never changes keeps its model through weekly identification",
        "tests/proofs/test_null_campaigns.py",
        minutes=6,
    ),
    _tests(
        "simulated-weeks",
        "twelve weeks of a wearing robot: the first probe sees it, one model is promoted",
        "tests/proofs/test_simulation.py",
        minutes=16,
    ),
    _tests(
        "schedule",
        "a schedule killed again and again does each occasion once",
        "tests/proofs/test_schedule.py",
        minutes=2,
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
        minutes=8,
    ),
    _tests(
        "fleet",
        "a hundred robots fitted by processes and by Dask give the same bits",
        "tests/proofs/test_fleet.py",
        minutes=9,
    ),
    _tests(
        "fleet-outliers",
        "of thirty simulated robots exactly the worn ones are reported as outliers",
        "tests/proofs/test_fleet_mock.py",
        minutes=8,
    ),
    _tests(
        "ur-programs",
        "whole programs on a mock UR5 through ur-rtde lose no sample and give the same models",
        "tests/proofs/test_ur.py",
        minutes=25,
    ),
    _tests(
        "tracing",
        "exported programs give a model's efforts, and a changed number of exported JSON is found",
        "tests/export/test_conformance.py",
        "tests/export/test_json_columns.py",
        minutes=2,
    ),
    _tests(
        "wire",
        "drivers keep the contract of a robot over real sockets, at length",
        "tests/drivers/ur",
        "tests/drivers/twincat",
        "tests/robot/test_conformance.py",
        minutes=6,
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
        minutes=17,
        further="docs/**/*.md",
    ),
    _tests(
        "notebooks",
        "the notebooks run from beginning to end",
        "tests/proofs/test_notebooks.py",
        minutes=2,
        further="docs/**/*.ipynb examples/**/*",
    ),
    _tests(
        "example",
        "the example projects' own CI passes against the wheel",
        "tests/proofs/test_example.py",
        minutes=3,
        further="examples/**/*",
    ),
    _tests(
        "wheel",
        "the wheel works in fresh environments",
        "tests/proofs/test_wheels.py",
        minutes=10,
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
        "Levenberg–Marquardt takes a tenth of pyrenn's time to the same error, or less",
        "tests/bench/test_lm.py",
        minutes=8,
    ),
    _tests(
        "lagrangian",
        "the Lagrangian network's torque is computed at least twice as fast as by torch.func",
        "tests/bench/test_lagrangian.py",
        minutes=6,
    ),
    _tests(
        "excitation",
        "the excitation optimiser finds better motions in less time than its peers",
        "tests/bench/test_excite.py",
        minutes=11,
    ),
    _tests(
        "benches",
        "benchmarks of starts, predictions and CAN time what they name and compare equal results",
        "tests/bench/test_can.py",
        "tests/bench/test_predict.py",
        "tests/bench/test_startup.py",
        minutes=1,
    ),
    _bench(
        "can",
        "a CAN cycle of six axes costs 350 µs of CPU or less at 1 kHz, half of canopen's",
        "ours_1000hz_cpu_us<=350",
        "cpu_master_only_vs_tuned_1000hz>=2",
        "cpu_both_ends_1000hz>=2",
        minutes=1,
    ),
    _bench(
        "startup",
        "`import hil` takes at most 1.5 times a bare Python, `hil --help` 4 times `import numpy`",
        "import_hil_vs_python<=1.5",
        "hil_help_vs_import_numpy<=4",
        minutes=1,
    ),
    _bench(
        "mcap",
        "MCAP costs no more CPU than by its library, and reading a tenth of its ROS 2 decoder",
        "write_vs_mcap_writer>=1",
        "columnar_vs_iterator_frombuffer>=1",
        "columnar_vs_ros2_decoder>=10",
        minutes=1,
    ),
    _bench(
        "rtde",
        "RTDE is read without a loss ten times faster than real time, for 1.25 × ur-rtde's CPU",
        "real_missing<=0",
        "free_missing<=0",
        "free_run_factor>=10",
        "cpu_vs_ur_rtde>=0.8",
        minutes=2,
    ),
    _bench(
        "regressor",
        "compiled regressors and torques cost half of a loop over Pinocchio or less",
        "regressor_vs_pinocchio_loop>=2",
        "base_regressor_vs_pinocchio_reduced>=2",
        "inverse_dynamics_vs_pinocchio_loop>=2",
        minutes=1,
    ),
    _bench(
        "collision",
        "distances along a path cost a fifth of computing each, or less",
        "path_search_vs_every_sample>=5",
        minutes=1,
    ),
    _bench(
        "predict",
        "exported C predicts within 100 µs at the median, ten times faster than onnxruntime",
        "memory_portable_p50_ns<=100000",
        "network_portable_p50_ns<=100000",
        "lagrangian_portable_p50_ns<=100000",
        "memory_onnxruntime_over_c>=10",
        "network_onnxruntime_over_c>=10",
        "lagrangian_onnxruntime_over_c>=10",
        minutes=3,
    ),
    _bench(
        "catalogue",
        "two thousand runs are queried within a second, in half the time of reading them or less",
        "query_s<=1",
        "query_vs_reading>=2",
        "query_after_one_change_vs_reading>=2",
        minutes=1,
    ),
    _bench(
        "interlocks",
        "judging every sample costs less than its distances by coal, in blocks of 16 a quarter",
        "blocks_of_1_vs_coal>=1.3",
        "blocks_of_16_vs_coal>=4",
        minutes=1,
    ),
    _bench(
        "crash",
        "a killed recording can be read and has lost a quarter of a second at most",
        "unreadable<=0",
        "unrecovered_runs<=0",
        "worst_loss_s<=0.25",
        "worst_loss_plain_writer_vs_recorder>=5",
        minutes=2,
    ),
    _bench(
        "diffnea",
        "DiffNEA reaches the least loss that was found, in half the time of L-BFGS or less",
        "newton_excess<=0.001",
        "newton_vs_lbfgs>=2",
        "newton_vs_lbfgs_rows>=2",
        minutes=1,
    ),
)
