"""Every kind of model as every target: exported under one contract, or refused with a way out.

What is special to a target is in the file of its name.
"""

from __future__ import annotations

import copy
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core import plugins
from hil.core.errors import FitError, HilError, PluginError, RecordingError, SpecError
from hil.dynamics import RobotModel
from hil.estimators import estimator, load_model_file, save_model
from hil.estimators.base import GROUP, RobotEstimator
from hil.export import onnx_export
from hil.export.agreement import LOAD, Golden, Step, golden_of, jittered, load_row
from hil.export.c import comment_text
from hil.export.c_compiler import compiler
from hil.export.exported import Exported, effort_unit
from hil.export.program import program_of
from hil.export.targets import ENDINGS, TARGETS, written_as
from hil.export.torch_export import pickles
from tests.support import export_readers as readers
from tests.support.export_models import fitted, smooth
from tests.support.export_readers import off_by
from tests.support.paths import DOCS

TABLE = """
kind                            c      torch  onnx   urdf    onnx-mlp  json
rigid-wls hard on sliding       yes    yes    yes    yes     chain     yes
rigid-linear on tx40@motors     yes    module module motors  chain     yes
rigid-lmi on panda              yes    module module yes     chain     yes
rigid-irls                      yes    module module yes     chain     yes
rigid-diffnea memory            yes    module module yes     chain     yes
rigid-hysteresis every group    yes    yes    yes    bodies  chain     yes
residual folds                  yes    yes    yes    bodies  chain     yes
residual measured               hears  hears  hears  bodies  chain     yes
lagrangian: stribeck dahl       yes    module yes    bodies  yes       yes
lagrangian: dissipative         yes    yes    yes    bodies  yes       yes
static-wls                      rest   rest   rest   parts   chain     yes
static-linear                   rest   rest   rest   parts   chain     yes
static-inverse                  rest   rest   rest   parts   chain     yes
static-coulomb                  rest   rest   rest   parts   chain     yes
static-hysteresis               rest   rest   rest   parts   chain     yes
static-mlp-lm                   rest   rest   rest   parts   yes       yes
"""
REFUSALS = {
    "rest": ("predicts efforts at standstill", r"HandGuiding[\s\S]*--to json"),
    "hears": ("needs the torque that the controller has to predict", "inputs: motion"),
    "motors": ("some motors move two joints", "--to json.*robot: tx40"),
    "bodies": ("no physically consistent links .* shares of the joint's largest torque: .*%",
               "rigid-lmi or rigid-hysteresis.*--no-check"),
    "parts": ("does not separate gravity and inertia", "--to json"),
    "chain": ("is not a chain of fully connected layers", "--to c .*--to onnx"),
}  # fmt: skip
"""Why a kind is no target: the message, and what the hint names in its place.

`yes` is exported. `module`: so it is, of the same operations as other rows. As tracing takes
seconds, its module is held against the model in `test_torch.py` instead.
"""


class Pair(NamedTuple):
    kind: str
    to: str
    outcome: str

    @property
    def cheap(self) -> bool:
        """Whether it takes well below a second."""
        small = self.kind.startswith("static") or self.kind.endswith("sliding")
        return small and (self.outcome in REFUSALS or self.to not in ("torch", "onnx"))

    @property
    def mark(self) -> str:
        """The tier of its tests, empty for the first one."""
        if (self.kind, self.to) in LONGEST:
            return "proof"
        return "" if self.cheap else "thorough"


def pairs() -> list[Pair]:
    head, *rows = (re.split(r"\s{2,}", line) for line in TABLE.strip().splitlines())
    cells = [(row[0], " ".join(row[1:]).split()) for row in rows]
    return [Pair(kind, *one) for kind, row in cells for one in zip(head[1:], row, strict=True)]


LONGEST = {
    ("lagrangian: dissipative", "onnx"),
    ("lagrangian: stribeck dahl", "onnx"),
    ("residual folds", "torch"),
    ("rigid-hysteresis every group", "onnx"),
}
"""Pairs whose tracing takes about ten seconds. Their modules are held against the models in
`test_torch.py`, and each kind is traced as the other target, or each target for another kind.
"""


def those(found: list[Pair]) -> pytest.MarkDecorator:
    marks = {"": (), "thorough": pytest.mark.thorough, "proof": pytest.mark.proof}
    marked = [
        pytest.param(one.kind, one.to, marks=marks[one.mark], id=f"{one.kind}-{one.to}")
        for one in found
    ]
    return pytest.mark.parametrize(("kind", "to"), marked)


def exports(*targets: str, kinds: tuple[str, ...] = ("",)) -> pytest.MarkDecorator:
    """All that is exported: as these targets (else any), of kinds that begin so."""
    found = [one for one in pairs() if one.outcome == "yes" and one.kind.startswith(kinds)]
    return those([one for one in found if one.to in (targets or TARGETS)])


OUTCOMES = {pair[:2]: pair.outcome for pair in pairs()}


def share_of(kind: str, to: str) -> float:
    """Largest difference that there may be, as a share of each joint's largest effort."""
    single = kind.startswith("lagrangian") and (to != "c" or "dissipative" in kind)
    return 1e-5 if single else 2e-6 if kind.startswith("residual") else 1e-11


def needs(to: str) -> None:
    """Skip a test without what a target takes to be written and checked."""
    libraries = {"torch": ["torch"], "onnx": ["torch", "onnx", "onnxscript", "onnxruntime"],
                 "onnx-mlp": ["onnx", "onnxruntime"], "urdf": ["cvxpy"]}  # fmt: skip
    for library in libraries.get(to, []):
        pytest.importorskip(library, reason=f"{library} is not installed")
    if to == "c" and compiler() is None:
        pytest.skip("there is no C compiler")


class Made(NamedTuple):
    model: RobotEstimator
    told: Exported
    folder: Path


def content_of(out: Path) -> dict[str, bytes]:
    """Bytes by the name of the file; a file alone has none."""
    if out.is_dir():
        return {path.name: path.read_bytes() for path in out.iterdir()}
    return {"": out.read_bytes()}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """What is written of a kind as a target; each once."""
    made: dict[tuple[str, str], Made] = {}

    def of(kind: str, to: str) -> Made:
        needs(to)
        if (kind, to) not in made:
            folder = tmp_path_factory.mktemp(to)
            options = {"unchecked": True} if to == "c" else {}  # its self-test is run here
            with pytest.MonkeyPatch.context() as patch:
                if to in METADATA and kind != SMALL[to]:  # looked at in full once, for its time
                    patch.setattr(f"{TARGETS[to][0]}.golden_of", short_golden)
                told = written_as(fitted(kind), folder / f"arm{ENDINGS[to]}", to, **options)
            made[kind, to] = Made(fitted(kind), told, folder)
        return made[kind, to]

    return of


@cache
def short_golden(model: RobotEstimator) -> Golden:
    return golden_of(model, 60)


@pytest.fixture(scope="module")
def steps(exported):
    """By kind and target, a program of ONNX or PyTorch and the size of its state; loaded once."""
    made: dict[tuple[str, str], tuple[Step, int]] = {}

    def of(kind: str, to: str) -> tuple[Step, int]:
        out = exported(kind, to).told.out
        if (kind, to) not in made:
            step = import_module(TARGETS[to][0]).loaded(out.read_bytes())
            made[kind, to] = step, int(METADATA[to](out)["state_size"])
        return made[kind, to]

    return of


@pytest.fixture(scope="module")
def efforts(exported, steps, tmp_path_factory):
    """By kind and target, what its users compute with it."""

    def of(kind: str, to: str) -> readers.Efforts:
        model, told, _ = exported(kind, to)
        if to == "c":
            return readers.c_efforts(told.out, tmp_path_factory.mktemp("build"), model)
        if to == "json":
            return readers.json_efforts(json.loads(told.out.read_text("utf-8")))
        return readers.traced_efforts(*steps(kind, to))

    return of


METADATA = {"torch": readers.torch_metadata, "onnx": readers.onnx_metadata}


def held_out(model: RobotEstimator, samples: int = 70) -> readers.Motion:
    """A motion that neither fit nor export saw; it ends with a rest under an encoder's noise."""
    _, q, qd, qdd = smooth(model.robot_.n, 9, samples)
    q[-20:], qd[-20:], qdd[-20:] = q[-20], 0.0, 0.0
    return jittered(q, qd), qd, qdd


def test_every_estimator_of_hil_and_every_target_is_in_the_table() -> None:
    ours = {n for n in plugins.names(GROUP) if plugins.load(GROUP, n).__module__[:4] == "hil."}
    in_table = {re.split("[ :]", kind)[0] for kind, _ in OUTCOMES}
    assert not ours - in_table, "add a model to tests/support/export_models.py and its row here"
    assert in_table == ours
    assert {to for _, to in OUTCOMES} == set(TARGETS) == set(ENDINGS)


@exports("c", "torch", "onnx")
def test_a_program_streams_the_efforts_of_the_model(kind, to, exported, efforts) -> None:
    """Each time from the start, bare, with a load, and with one that is mounted on the way."""
    model, stream = exported(kind, to).model, efforts(kind, to)
    motion, share = held_out(model), share_of(kind, to)
    bare, loaded = (readers.streamed(model, motion, load) for load in (Payload(), LOAD))
    assert off_by(stream(motion, [Payload()] * len(bare)), bare) < share
    assert off_by(stream(motion, [LOAD] * len(bare)), loaded) < share
    if not kind.startswith("residual"):  # whose network remembers efforts
        on = np.arange(len(bare)) % 9 < 4
        mixed = stream(motion, [LOAD if one else Payload() for one in on])
        assert off_by(mixed, np.where(on[:, None], loaded, bare)) < share


@exports("json", kinds=("rigid", "residual"))
def test_a_document_has_the_efforts_of_the_model(kind, to, exported, efforts) -> None:
    model = getattr(exported(kind, to).model, "base_", exported(kind, to).model)
    motion = held_out(model)
    for load in (Payload(), LOAD):
        found = efforts(kind, to)(motion, [load] * len(motion[0]))
        assert off_by(found, readers.streamed(model, motion, load)) < 1e-11


@exports("urdf")
def test_a_urdf_has_the_gravity_and_inertia_of_the_model(kind, to, exported) -> None:
    model, told, _ = exported(kind, to)
    motion, expected = held_out(model), 0.0
    parts = readers.parts_of(model, motion)
    for name in {"gravity", "inertia", "coriolis"} & parts.keys():
        expected = expected + parts[name]
    share = 1e-9 if told.found.exact else 0.02
    assert off_by(readers.urdf_torques(told.out, motion), expected) < share
    assert off_by(RobotModel.from_urdf(told.out).inverse_dynamics(*motion), expected) < share


@exports("onnx-mlp")
def test_a_chain_has_the_numbers_of_its_part_of_the_model(kind, to, exported) -> None:
    from hil.export.onnx_mlp import chain_of, onnxruntime_says

    model, told, _ = exported(kind, to)
    q = held_out(model)[0]
    expected = chain_of(model).says(q)
    assert off_by(onnxruntime_says(told.out.read_bytes())(q), expected) < 1e-5


@pytest.mark.thorough
@exports()
def test_a_result_says_what_was_written_and_how_well_it_agrees(kind, to, exported) -> None:
    model, told, folder = exported(kind, to)
    assert [path.name for path in folder.iterdir()] == [told.out.name]
    assert set(told.files) == (content_of(told.out).keys() if to == "c" else {told.out.name})
    assert told.joint_names == model.joint_names_
    assert told.parts.startswith(f"{model.estimator}, ")
    effort, friction = effort_unit(model.effort_kind_), to == "onnx-mlp" and "static" in kind
    assert told.effort_unit == (effort if friction or to not in ("urdf", "onnx-mlp") else "")
    assert re.match(CHECKED[to], told.checked)
    if to in ("c", "torch", "onnx"):
        assert ("with memory" in told.parts) == program_of(model).remembers


CHECKED = {
    "c": "$",  # unchecked
    "torch": "read back: largest difference",
    "onnx": "read back: largest difference",
    "urdf": "read back and compared with the model: gravity and inertia",
    "onnx-mlp": "onnxruntime: largest difference",
    "json": "computed from the document alone|not compared: networks",
}


@exports()
def test_a_file_carries_estimator_robot_joints_and_unit_and_no_path(kind, to, exported) -> None:
    model, told, _ = exported(kind, to)
    expected = {
        "estimator": model.estimator,
        "robot": Path(model.robot_.name).name,
        "joints": list(model.joint_names_),
        "unit": effort_unit(model.effort_kind_),
    }
    if to == "c":
        expected["robot"] = comment_text(expected["robot"])
    found = readers.facts_of(to, told.out)
    assert found == {name: expected[name] for name in found}
    assert "joints" in found
    assert len(found) == 4 or to in ("torch", "onnx", "urdf", "onnx-mlp")
    for content in content_of(told.out).values():
        assert str(Path(__file__).parents[1]).encode() not in content


@exports("onnx")
def test_a_graph_is_what_small_runtimes_take(kind, to, exported) -> None:
    import onnx

    model, told, _ = exported(kind, to)
    graph, said = onnx.load(told.out), readers.onnx_metadata(told.out)
    onnx_export.require_plain(graph)
    used = {node.op_type for node in onnx_export.nodes_of(graph.graph)}
    assert not [name for name in used if "Gather" in name or "Scatter" in name]
    assert [(one.domain, one.version) for one in graph.opset_import] == [("", 20)]
    assert not graph.functions
    sizes = {}
    for value in (*graph.graph.input, *graph.graph.output):
        rows, *fixed = value.type.tensor_type.shape.dim
        assert rows.dim_param == "rows"
        (sizes[value.name],) = (dim.dim_value for dim in fixed)
    n, state = model.robot_.n, int(said["state_size"])
    carried = {"state": state, "state_next": state} if program_of(model).remembers else {}
    assert sizes == {"q": n, "qd": n, "qdd": n, "load": 10, "effort": n} | carried
    assert sum(size for _, size in json.loads(said["state"])) == state
    assert b".py" not in told.out.read_bytes()
    counts = "the memory of its network is in samples: call it at 100 Hz" in told.notes
    assert counts == kind.startswith("residual") == bool(said["rate_hz"])


@exports("torch")
def test_a_torch_program_scatters_nothing_and_holds_no_pickle(kind, to, exported) -> None:
    import torch

    told = exported(kind, to).told
    assert pickles(told.out.read_bytes()) == []
    graph = torch.export.load(told.out).graph
    used = {str(node.target) for node in graph.nodes if node.op == "call_function"}
    assert not [name for name in used if any(w in name for w in ("index", "gather", "scatter"))]


AGAIN = ("static", "rigid-wls", "rigid-hyst", "residual", "lagrangian: dissipative")


@those([
    one for one in pairs()
    if one.outcome == "yes" and one.kind.startswith(AGAIN)
    and (one.to not in ("torch", "onnx") or "sliding" in one.kind)
])  # fmt: skip
def test_a_model_read_from_its_folder_gives_the_same_bytes(
    kind, to, exported, tmp_path, monkeypatch
) -> None:
    model, told, _ = exported(kind, to)
    again = load_model_file(save_model(model, tmp_path / "model"))
    if to in METADATA:
        monkeypatch.setattr(f"{TARGETS[to][0]}.golden_of", short_golden)
    options = {"unchecked": True} if to == "c" else {}
    out = written_as(again, tmp_path / told.out.name, to, **options).out
    # A model's folder keeps the description of an arm as robot.urdf.
    found = {
        name: content.replace(b"robot.urdf", Path(model.robot_.name).name.encode())
        for name, content in content_of(out).items()
    }
    assert found == content_of(told.out)


@pytest.mark.thorough
@pytest.mark.parametrize("to", ["c", "json"])
def test_another_process_writes_the_same_bytes(to, exported, tmp_path) -> None:
    """Whatever the order of its sets."""
    model, told, _ = exported("rigid-hysteresis every group", to)
    folder, out = save_model(model, tmp_path / "model"), tmp_path / told.out.name
    command = [sys.executable, "-m", "hil", "export", folder, "--to", to, "-o", out]
    command += ["--no-check"] * (to == "c")
    subprocess.run(
        command, env=os.environ | {"PYTHONHASHSEED": "1"}, check=True, capture_output=True
    )
    assert content_of(out) == content_of(told.out)


@those([one for one in pairs() if one.outcome in REFUSALS])
def test_what_is_no_target_is_refused_with_what_would_do(kind, to, tmp_path) -> None:
    needs(to)
    message, hint = REFUSALS[OUTCOMES[kind, to]]
    with pytest.raises(FitError, match=message) as refused:
        written_as(fitted(kind), tmp_path / f"arm{ENDINGS[to]}", to)
    assert refused.value.message.startswith((fitted(kind).estimator, "the ", "no ", "tx40"))
    assert re.search(hint, str(refused.value.hint), re.DOTALL)
    assert list(tmp_path.iterdir()) == []


# Rules of writing, which do not depend on the kind of model.

SMALL = {to: "static-mlp-lm" if to == "onnx-mlp" else "rigid-wls hard on sliding" for to in TARGETS}
ALL = pytest.mark.parametrize("to", TARGETS)
HEAVY = dict.fromkeys(("torch", "onnx", "urdf"), pytest.mark.thorough)
BUT_TRACED = pytest.mark.parametrize(
    "to", [pytest.param(to, marks=HEAVY.get(to, ())) for to in TARGETS if to not in METADATA]
)


def written(to: str, out: Path, model: RobotEstimator | None = None, **options: Any) -> Exported:
    needs(to)
    return written_as(fitted(SMALL[to]) if model is None else model, out, to, **options)


@ALL
@pytest.mark.parametrize("there", ["file", "folder", "link to nothing"])
def test_nothing_is_written_over(there, to, tmp_path) -> None:
    out = tmp_path / f"arm{ENDINGS[to]}"
    if there == "file":
        out.write_text("mine", "utf-8")
    elif there == "folder":
        out.mkdir()
    else:
        out.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="exists already"):
        written(to, out)
    assert list(tmp_path.iterdir()) == [out]
    assert there != "file" or out.read_text("utf-8") == "mine"


@ALL
def test_names_that_cannot_be_are_one_error(to, tmp_path) -> None:
    with pytest.raises(RecordingError, match="cannot write"):
        written(to, tmp_path / f"{'n' * 300}{ENDINGS[to]}")


@BUT_TRACED
def test_folders_are_made_and_places_that_cannot_be_written_are_one_error(to, tmp_path) -> None:
    options = {"unchecked": True} if to == "c" else {}
    long = f"{'n' * 230}{ENDINGS[to]}"  # a name that is hidden while it is written has to fit, too
    assert written(to, tmp_path / "new" / "deep" / long, **options).out.exists()
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file" / f"a{ENDINGS[to]}", Path(f"/proc/a{ENDINGS[to]}")):
        with pytest.raises(RecordingError, match="cannot write"):
            written(to, out, **options)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["file", "new"]


@BUT_TRACED
def test_a_full_disk_leaves_nothing_behind(to, tmp_path, monkeypatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    texts = Path.write_text
    monkeypatch.setattr("hil.core.files.os.fsync", full)
    monkeypatch.setattr(
        Path, "write_text", lambda path, *a: full() if path.suffix == ".c" else texts(path, *a)
    )
    options = {"unchecked": True} if to == "c" else {}
    with pytest.raises(RecordingError, match=r"cannot write .*: No space left on device"):
        written(to, tmp_path / f"arm{ENDINGS[to]}", **options)
    assert list(tmp_path.iterdir()) == []


@ALL
def test_a_model_that_is_not_fitted_is_refused(to, tmp_path) -> None:
    with pytest.raises(FitError, match="is not fitted yet"):
        written(to, tmp_path / "arm", estimator("rigid-wls"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("to", ["c", "json", pytest.param("urdf", marks=HEAVY["urdf"])])
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("coefficients_", lambda value: value * np.nan),
        ("coefficients_", lambda value: value[:-1]),
        ("torque_scale_", lambda value: value[:-1]),
        ("torque_scale_", lambda value: value[:0]),
    ],
    ids=["not a number", "one too few", "a joint without scale", "no scale"],
)
def test_damaged_models_are_told_as_such(to, name, change, tmp_path) -> None:
    damaged = copy.copy(fitted("rigid-wls hard on sliding"))
    setattr(damaged, name, change(getattr(damaged, name)))
    with pytest.raises(HilError):
        written(to, tmp_path / "out", damaged)
    assert list(tmp_path.iterdir()) == []


BENT: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "c": ("hil.export.c._with_prefix",
          lambda honest: lambda text, prefix: honest(text, prefix).replace(
              "hil_scale[3] = {", "hil_scale[3] = {1.001 * "),
          "the C program does not agree with the model: largest difference"),
    "urdf": ("hil.export.urdf.inertial", lambda honest: lambda body: honest(body * 1.3),
             "gravity and inertia of the URDF, read back, differ .* by 0.3"),
    "onnx-mlp": ("hil.export.onnx_mlp.chain_of",
                 lambda honest: lambda model: bent_chain(honest(model)),
                 "the ONNX file does not agree with the model: largest difference"),
    "json": ("hil.export.json_export.parameters_of",
             lambda honest: lambda model: [
                 one | {"value": 1.01 * one["value"]} for one in honest(model)],
             "differ from the model's by"),
    "torch": ("hil.export.torch_export.loaded", lambda honest: bent_step(honest),
              "the PyTorch program does not agree with the model: largest difference 1"),
    "onnx": ("hil.export.onnx_export.loaded", lambda honest: bent_step(honest),
             "the ONNX graph does not agree with the model: largest difference 1"),
}  # fmt: skip
"""Target → something on its way, bent, and the error."""


def bent_chain(chain: Any) -> Any:
    return replace(chain, says=lambda q: 1.001 * chain.says(q))


def bent_step(honest: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    def loaded(content: bytes) -> Any:
        step = honest(content)
        return lambda inputs: [1.001 * one for one in step(inputs)]

    return loaded


def traced_once(to: str, exported: Any, patch: pytest.MonkeyPatch) -> None:
    """Let the small model be exported again without tracing it again."""
    content = exported(SMALL[to], to).told.out.read_bytes()
    tracer = {"torch": "archive", "onnx": "graph"}[to]
    patch.setattr(f"{TARGETS[to][0]}.{tracer}", lambda traced: content)
    patch.setattr(f"{TARGETS[to][0]}.golden_of", short_golden)


@pytest.mark.parametrize("to", [pytest.param(to, marks=HEAVY.get(to, ())) for to in TARGETS])
def test_what_does_not_agree_is_not_written(to, exported, tmp_path, monkeypatch) -> None:
    needs(to)
    if to in METADATA:
        traced_once(to, exported, monkeypatch)
    place, bend, words = BENT[to]
    module, _, name = place.rpartition(".")
    monkeypatch.setattr(place, bend(getattr(import_module(module), name)))
    with pytest.raises(FitError, match=words):
        written(to, tmp_path / f"arm{ENDINGS[to]}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_other_endings_than_torch_likes_and_joints_that_slide_are_noted(
    exported, tmp_path, monkeypatch
) -> None:
    traced_once("torch", exported, monkeypatch)
    assert written("torch", tmp_path / "arm.bin").notes == (
        "torch.export.load warns about file names other than *.pt2",
        "prismatic joints: r; positions in m, efforts in N",
    )


@pytest.mark.parametrize(
    ("to", "place", "library", "extra"),
    [
        ("torch", "hil.export.torch_export.find_spec", "torch", "learn"),
        ("onnx", "hil.export.onnx_export.find_spec", "onnxruntime", "onnx"),
        ("onnx-mlp", "hil.export.onnx_mlp.find_spec", "onnx", "onnx"),
    ],
)
def test_without_its_libraries_the_extra_is_named(
    to, place, library, extra, tmp_path, monkeypatch
) -> None:
    needs(to)
    monkeypatch.setattr(place, lambda name: None if name == library else name)
    with pytest.raises(PluginError, match=f"needs {library}, which is not installed") as refused:
        written_as(fitted(SMALL[to]), tmp_path / f"arm{ENDINGS[to]}", to)
    assert refused.value.hint == f'pip install "hil[{extra}]"'


def test_without_a_compiler_only_what_is_said_to_be_unchecked_is_written(
    tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    model = fitted(SMALL["c"])
    with pytest.raises(PluginError, match="no C compiler") as refused:
        written_as(model, tmp_path / "out", "c")
    assert "--no-check" in str(refused.value.hint)
    assert list(tmp_path.iterdir()) == []
    assert written_as(model, tmp_path / "out", "c", unchecked=True).checked == ""
    assert (tmp_path / "out" / "hil_test.c").is_file()


def test_an_option_that_is_not_taken_is_as_good_as_none(tmp_path) -> None:
    assert written("json", tmp_path / "a.json", unchecked=False, prefix=None).out.exists()
    with pytest.raises(SpecError, match="no option --no-check"):
        written("json", tmp_path / "b.json", unchecked=True)


@pytest.mark.parametrize(
    ("out", "to", "message", "hint"),
    [
        ("a", "matlab", "unknown format --to 'matlab'", "json"),
        ("a.onnx", "c", "writes a folder", "--to onnx"),
        ("a.json", "urdf", "writes a file that ends with .urdf", "a.urdf, or with --to json"),
        ("a.cpp", "torch", "ends with .pt2", "a.pt2"),
    ],
)
def test_targets_and_endings_that_do_not_fit_are_refused(out, to, message, hint, tmp_path) -> None:
    with pytest.raises(SpecError, match=message) as refused:
        written_as(fitted(SMALL["c"]), tmp_path / out, to)
    assert hint in str(refused.value.hint)


# Examples of pages, with files as they are written.

PAGE = (DOCS / "how-to" / "export-onnx-torch.md").read_text("utf-8")


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("rigid-wls hard on sliding", marks=pytest.mark.thorough),
        pytest.param("rigid-hysteresis every group", marks=pytest.mark.proof),
    ],
)
def test_the_example_for_onnx_runs(kind, exported, tmp_path, monkeypatch) -> None:
    model, told, _ = exported(kind, "onnx")
    (tmp_path / "arm.onnx").write_bytes(told.out.read_bytes())
    monkeypatch.chdir(tmp_path)
    motion = held_out(model)
    found = {"samples": zip(*motion, strict=True)}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0], found)
    expected = readers.streamed(model, motion, Payload())
    assert found["effort"][0] == pytest.approx(expected[-1], abs=1e-9)


@pytest.mark.thorough
def test_the_example_for_torch_runs(exported, tmp_path, monkeypatch) -> None:
    model, told, _ = exported("rigid-hysteresis every group", "torch")
    import torch

    (tmp_path / "arm.pt2").write_bytes(told.out.read_bytes())
    monkeypatch.chdir(tmp_path)
    row = [one[:1] for one in held_out(model)]
    inputs = zip(("q", "qd", "qdd", "load"), [*row, load_row(LOAD)], strict=True)
    found = {name: torch.tensor(value) for name, value in inputs}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[1], found)
    expected = readers.streamed(model, tuple(row), LOAD)
    assert found["effort"][0].numpy() == pytest.approx(expected[0], abs=1e-9)


@exports("torch", "onnx")
def test_rows_are_streams_of_their_own(kind, to, exported, steps) -> None:
    """Three at once, the second of which is the one that runs alone."""
    step, size = steps(kind, to)
    motion = held_out(exported(kind, to).model)
    together, alone = ([np.zeros((rows, size))] * bool(size) for rows in (3, 1))
    mounted = np.vstack([load_row(load) for load in (LOAD, Payload(), LOAD)])
    among, lone = [], []
    for k in range(25):
        rows = [one[[69 - k, k, k // 2]] for one in motion]
        effort, *together = step([*rows, mounted, *together])
        one, *alone = step([*(row[1:2] for row in rows), mounted[1:2], *alone])
        among.append(effort[1])
        lone.append(one[0])
    assert off_by(np.array(among), np.array(lone)) < share_of(kind, to)
