"""Models as PyTorch programs: the same numbers, any number of rows, no code in the file."""

from __future__ import annotations

import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.paths import ROOT

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.arms.payload import Payload  # noqa: E402
from hil.core.errors import FitError, PluginError, RecordingError  # noqa: E402
from hil.dynamics import RobotModel  # noqa: E402
from hil.estimators import estimator  # noqa: E402
from hil.export import torch_export  # noqa: E402
from hil.export.agreement import LOAD, golden_of, largest_difference, load_row  # noqa: E402
from hil.export.agreement import motion as golden_motion  # noqa: E402
from hil.export.program import bodies, flange_in_last_joint  # noqa: E402
from hil.export.torch_export import export_torch, pickles  # noqa: E402
from hil.export.torch_modules import RigidTorque, StreamingTcn, module_of  # noqa: E402
from tests.export.test_c_network import KINDS as NETWORKS  # noqa: E402
from tests.support.export_models import KINDS, fitted  # noqa: E402
from tests.support.export_network_parts import correction, motion, streamed  # noqa: E402

PAGE = (ROOT / "docs/how-to/export-onnx-torch.md").read_text("utf-8")


def stepping(module):
    def step(inputs):
        with torch.no_grad():
            return [found.numpy() for found in module(*map(torch.tensor, inputs))]

    return step


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_a_module_says_what_the_model_says(kind) -> None:
    traced, golden = module_of(fitted(kind)), golden_of(fitted(kind), samples=120)
    assert largest_difference(stepping(traced.module), golden, traced.state_size) < 1e-12
    assert bool(traced.state_size) == ("hysteresis" in kind)


@pytest.mark.parametrize("kind", NETWORKS.values(), ids=NETWORKS)
def test_a_network_says_what_its_stream_says(kind) -> None:
    networks, rows = correction(**kind), motion()
    module = StreamingTcn(networks)
    carried = {name: torch.zeros(1, size, dtype=torch.float64) for name, size in module.parts}
    found, expected = [], streamed(networks, rows)
    for k, row in enumerate(rows):
        with torch.no_grad():
            inputs = (torch.tensor(one[None]) for one in row)
            added, carried = module(*inputs, torch.full((1, 1), k > 0), carried)
        found.append(added[0].numpy())
    assert np.array(found) == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_physics_and_network_together() -> None:
    traced, golden = module_of(fitted("residual")), golden_of(fitted("residual"), samples=60)
    assert largest_difference(stepping(traced.module), golden, traced.state_size) < 1e-6
    assert traced.rate_hz == pytest.approx(100.0)


def test_a_load_may_change_on_the_way() -> None:
    traced = module_of(fitted("rigid-hysteresis"))
    golden = golden_of(fitted("rigid-hysteresis"), samples=80)
    state = torch.zeros(1, traced.state_size, dtype=torch.float64)
    for k, sample in enumerate(zip(golden.q, golden.qd, golden.qdd, strict=True)):
        load, wanted = (Payload(), golden.bare) if k % 7 < 4 else (LOAD, golden.loaded)
        rows = (torch.tensor(one[None]) for one in sample)
        effort, state = traced.module(*rows, torch.tensor(load_row(load)), state)
        assert effort[0].numpy() == pytest.approx(wanted[k], abs=1e-12)


SLIDING = """<robot name="r"><link name="base"/>
<joint name="x" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0.5"/>
<origin xyz="0.1 0.2 0.3" rpy="0.1 -0.4 0.2"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
</joint><link name="cart"><inertial><origin xyz="0.1 0 0.05"/><mass value="3"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0.02" iyz="0"/></inertial></link>
<joint name="y" type="revolute"><parent link="cart"/><child link="arm"/><axis xyz="0.3 1 0"/>
<origin xyz="0 0.1 0.4" rpy="0.5 0 0.3"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
</joint><link name="arm"><inertial><origin xyz="0 0.2 0.1"/><mass value="2"/>
<inertia ixx="0.05" iyy="0.02" izz="0.04" ixy="0" ixz="0" iyz="0.01"/></inertial></link>
<joint name="z" type="prismatic"><parent link="arm"/><child link="tip"/><axis xyz="0 0.2 1"/>
<origin xyz="0.2 0 0" rpy="0 0.7 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="tip"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def test_joints_may_slide(tmp_path) -> None:
    (tmp_path / "r.urdf").write_text(SLIDING)
    robot = RobotModel.from_urdf(tmp_path / "r.urdf", rotor_inertia=[0.3, 0.2, 0.1])
    program = SimpleNamespace(
        n=3,
        geometry=robot.joint_geometry(),
        gravity=np.asarray(robot.gravity_vector),
        flange=flange_in_last_joint(robot),
        rigid=bodies(robot.parameters(), 3),
        gears=bodies(robot.parameters(), 3),
        coupling=None,
    )
    rows = golden_motion(robot, 60, 50.0)
    load = torch.tensor(load_row(LOAD))
    torque, _ = RigidTorque(program)(*(torch.tensor(one) for one in rows), load)
    expected = robot.with_payload(LOAD).inverse_dynamics(*rows)
    assert torque.numpy() == pytest.approx(expected, abs=1e-12)


def test_it_can_be_differentiated_for_control() -> None:
    traced = module_of(fitted("rigid-hysteresis"))
    random = torch.Generator().manual_seed(0)
    rows = [torch.rand(1, 6, generator=random, dtype=torch.float64) + 0.1 for _ in range(3)]
    load = torch.tensor(load_row(LOAD))
    start = torch.zeros(1, traced.state_size, dtype=torch.float64)
    _, state = traced.module(*rows, load, start)
    rows[0] = rows[0] + 2e-4  # a way on which memory comes round

    def effort(*motion):
        return traced.module(*motion, load, state)[0]

    inputs = tuple(row.requires_grad_() for row in rows)
    assert torch.autograd.gradcheck(effort, inputs, eps=1e-7, atol=1e-4)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A model with memory, and its file."""
    model = fitted("rigid-hysteresis")
    return model, export_torch(model, tmp_path_factory.mktemp("torch") / "model.pt2")


@pytest.mark.thorough
def test_the_file_is_read_back_and_compared(written) -> None:
    _, told = written
    assert float(told.checked.split()[4]) < 1e-12
    assert told.files == ("model.pt2",)
    assert told.effort_unit == "A"


@pytest.mark.thorough
def test_the_file_says_how_to_call_it(written) -> None:
    model, told = written
    extra = {"hil.json": ""}
    torch.export.load(told.out, extra_files=extra)
    said = json.loads(extra["hil.json"])
    assert json.loads(said["joint_names"]) == list(model.joint_names_)
    assert said["estimator"] == "rigid-hysteresis"
    assert said["effort_unit"] == "A"
    assert int(said["state_size"]) == sum(size for _, size in json.loads(said["state"]))


@pytest.mark.thorough
def test_the_example_of_the_page_runs(written, tmp_path, monkeypatch) -> None:
    model, told = written
    (tmp_path / "arm.pt2").write_bytes(told.out.read_bytes())
    monkeypatch.chdir(tmp_path)
    golden = golden_of(model, samples=80)
    rows = {name: torch.tensor(getattr(golden, name)[:1]) for name in ("q", "qd", "qdd")}
    found = {**rows, "load": torch.tensor(load_row(LOAD))}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[1], found)
    assert found["effort"][0].numpy() == pytest.approx(golden.loaded[0], abs=1e-12)


@pytest.mark.thorough
def test_many_streams_at_once_say_what_each_says(written) -> None:
    model, told = written
    program = torch.export.load(told.out).module()
    q, qd, qdd = (torch.tensor(one) for one in golden_motion(model.robot_, 80, 250.0))
    load = torch.tensor(load_row(LOAD))
    size = module_of(model).state_size
    state, alone = (torch.zeros(rows, size, dtype=torch.float64) for rows in (3, 1))
    for k in range(10):
        # The second of three streams is the one that runs alone.
        rows = [one[k : k + 60 : 20] for one in (q, qd, qdd)]
        effort, state = program(*rows, load.expand(3, 10), state)
        one, alone = program(*(row[1:2] for row in rows), load, alone)
        torch.testing.assert_close(effort[1:2], one, rtol=0.0, atol=1e-12)


@pytest.mark.thorough
def test_zeros_begin_again(written) -> None:
    model, told = written
    program = torch.export.load(told.out).module()
    first = golden_of(model, samples=80)
    q, qd, qdd = (torch.tensor(one) for one in (first.q, first.qd, first.qdd))
    load = torch.tensor(load_row(Payload()))
    zeros = torch.zeros(1, module_of(model).state_size, dtype=torch.float64)

    def efforts(rows, state):
        for k in rows:
            effort, state = program(q[k : k + 1], qd[k : k + 1], qdd[k : k + 1], load, state)
            yield effort, state

    *_, (_, state) = efforts(range(20), zeros)
    again = [effort for effort, _ in efforts(range(20, 30), zeros)]
    on = [effort for effort, _ in efforts(range(20, 30), state)]
    assert not torch.allclose(again[0], on[0])
    assert on[0][0].numpy() == pytest.approx(first.bare[20], abs=1e-12)
    stream = model.stream(Payload())
    expected = [stream.step(q[k].numpy(), qd[k].numpy(), qdd[k].numpy()) for k in range(20, 30)]
    assert torch.cat(again).numpy() == pytest.approx(np.array(expected), abs=1e-12)


def test_there_is_no_pickle_in_the_file(written) -> None:
    _, told = written
    assert pickles(told.out.read_bytes()) == []
    usual = io.BytesIO()
    program = torch.export.export(torch.nn.Linear(2, 2), (torch.zeros(1, 2),))
    torch.export.save(program, usual)
    assert pickles(usual.getvalue()) == ["archive/data/sample_inputs/model.pt"]


@pytest.mark.thorough
def test_a_program_that_says_something_else_is_not_written(written, tmp_path, monkeypatch) -> None:
    def bent(content):
        step = honest(content)
        return lambda inputs: [1.001 * one for one in step(inputs)]

    model, told = written
    honest, content = torch_export.loaded, told.out.read_bytes()
    monkeypatch.setattr(torch_export, "archive", lambda traced: content)
    monkeypatch.setattr(torch_export, "loaded", bent)
    with pytest.raises(FitError, match="PyTorch program does not agree with the model: off by 1"):
        export_torch(model, tmp_path / "model.pt2")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch) -> None:
    with pytest.raises(FitError, match="static-wls is not fitted"):
        export_torch(estimator("static-wls"), tmp_path / "model.pt2")
    with pytest.raises(RecordingError, match="exists already"):
        export_torch(fitted("rigid-wls"), tmp_path)
    monkeypatch.setattr(torch_export, "find_spec", lambda name: None)
    with pytest.raises(PluginError, match="needs torch") as refused:
        export_torch(fitted("rigid-wls"), tmp_path / "model.pt2")
    assert refused.value.hint == 'pip install "hil[learn]"'
