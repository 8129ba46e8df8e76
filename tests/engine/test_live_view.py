"""The live view of a run: its server, what viewers are shown, and of which rows."""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from hil.cli.run import live_view
from hil.core.errors import DataError, PluginError
from hil.core.typing import StructArray
from hil.engine import live_view as server_module
from hil.engine.live_view import (
    AT_ONCE,
    LAYOUT,
    PROGRESS_SCHEMA,
    PROGRESS_TOPIC,
    Decimation,
    FoxgloveLive,
    RobotTopics,
)
from hil.engine.standing import DEBUG, ERROR, INFO, WARNING, Standing, message_of
from hil.recording.mcap_reader import read_topic
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities, Status, state_dtype
from hil.robot.state import STATE_TOPIC
from hil.workflow.recording import recorded_capabilities
from tests.support.live_client import PROTOCOL, Message, Viewer
from tests.support.paths import EXPERIMENTS
from tests.support.waiting import until

# The live view over a real socket, to a client that knows the protocol and not the SDK


DWELL = EXPERIMENTS / "ci_dwell_12.yaml"
JOINTS = tuple(f"joint_{i + 1}" for i in range(6))
ROBOT = Capabilities(JOINTS, 125.0, "current")


def rows(n: int, begin: float = 0.0) -> StructArray:
    block = np.zeros(n, state_dtype(6))
    block["device_time"] = begin + np.arange(n) / 125
    block["host_time"] = 1.8e9 + block["device_time"]
    block["q"] = np.arange(n * 6).reshape(n, 6)
    block["q_target"] = block["q"] + 0.25
    block["status"] = Status.MOVING
    return block


def event_of(block: StructArray) -> dict[str, Any]:
    return {"kind": "rows", "rows": block}


@pytest.fixture
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Message], str]:
    """`hil run --live` on the mock, watched from its first moment; run, messages, stderr."""
    runs = tmp_path_factory.mktemp("runs")
    command = ["run", str(DWELL), "--runs", str(runs), "--json", "--live", "--live-port", "0"]
    told = runs / "stderr"
    with (
        told.open("w") as stderr,
        subprocess.Popen(
            [sys.executable, "-m", "hil", *command],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        ) as running,
    ):
        with Viewer(_url_in(told)) as viewer:
            messages = list(viewer.messages())
        out, _ = running.communicate(timeout=60)
    err = told.read_text("utf-8")
    assert running.returncode == 0, err
    return Path(json.loads(out)["run"]), messages, err


def _url_in(told: Path) -> str:
    line = re.compile(r"live view: (\S+)\n")
    return until(lambda: line.search(told.read_text("utf-8")), 100)[1]


def of(messages: list[Message], topic: str) -> list[Message]:
    return [message for message in messages if message.topic == topic]


@pytest.mark.wire
def test_joint_states_are_those_that_were_recorded(
    seen: tuple[Path, list[Message], str],
) -> None:
    run, messages, _ = seen
    shown = of(messages, "/joint_states")
    recorded = read_topic(RunDirectory.open(run).recordings[0], STATE_TOPIC)
    assert len(shown) >= 5
    for message in shown:
        stamp = message.data.header.stamp.sec + 1e-9 * message.data.header.stamp.nanosec
        row = recorded[np.argmin(np.abs(recorded["host_time"] - stamp))]
        assert row["host_time"] == pytest.approx(stamp, abs=1e-6)
        assert list(message.data.position) == row["q"].tolist()
        assert list(message.data.velocity) == row["qd"].tolist()
        assert list(message.data.effort) == row["effort"].tolist()
        assert message.data.name[2] == "elbow_joint"


@pytest.mark.wire
def test_the_whole_record_and_the_tracking_error_are_shown_too(
    seen: tuple[Path, list[Message], str],
) -> None:
    run, messages, _ = seen
    recorded = read_topic(RunDirectory.open(run).recordings[0], STATE_TOPIC)
    by_time = {row["device_time"]: row for row in recorded}
    states, errors = of(messages, STATE_TOPIC), of(messages, "/robot/tracking_error")
    assert len(states) == len(errors) >= 5
    for state, error in zip(states, errors, strict=True):
        row = by_time[state.data.device_time]
        assert list(state.data.temperature) == row["temperature"].tolist()
        assert state.data.segment == row["segment"]
        assert list(error.data.tracking_error) == (row["q_target"] - row["q"]).tolist()


@pytest.mark.wire
def test_rows_are_decimated_in_wall_time(seen: tuple[Path, list[Message], str]) -> None:
    times = [message.log_time_ns / 1e9 for message in of(seen[1], "/joint_states")]
    assert times == sorted(times)
    assert len(times) <= 60 * (times[-1] - times[0]) + 2 * 12


@pytest.mark.wire
def test_progress_and_events_tell_the_run_to_its_end(
    seen: tuple[Path, list[Message], str],
) -> None:
    progress = [message.data for message in of(seen[1], "/hil/progress")]
    assert progress[-1]["state"] == "done"
    assert progress[-1]["percent"] == 100
    assert {"planning", "writing the report"} <= {one["stage"] for one in progress}
    events = [message.data for message in of(seen[1], "/events")]
    assert {"stage", "state", "step"} <= {event.name for event in events}
    assert "running" in [event.msg for event in events if event.name == "state"]


@pytest.mark.wire
def test_the_terminal_says_where_to_look_and_with_which_layout(
    seen: tuple[Path, list[Message], str],
) -> None:
    assert "live view: ws://127.0.0.1:" in seen[2]
    assert str(server_module.LAYOUT) in seen[2]
    assert server_module.LAYOUT.is_file()


FLOOD = """
import sys, time
from tests.engine.test_live_view import ROBOT, Unlimited, event_of, rows
from hil.engine.live_view import FoxgloveLive

with FoxgloveLive(ROBOT, port=0) as live:
    print(live.url, flush=True)
    sys.stdin.readline()
    live._decimation = Unlimited()
    for _ in range(4000):  # 20 MB: more than any buffer takes
        live.notify(event_of(rows(12)))
    for _ in range(100):  # whoever reads gets these, whatever of the flood was left out for it
        live.notify(event_of(rows(13)))
        time.sleep(0.02)
print("stopped", flush=True)
"""


@pytest.mark.wire
def test_a_client_that_never_reads_holds_nothing_up() -> None:
    with (
        subprocess.Popen(
            [sys.executable, "-c", FLOOD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        ) as serving,
    ):
        assert serving.stdout is not None
        url = serving.stdout.readline().strip()
        with connect(url, subprotocols=[PROTOCOL], close_timeout=0.1, max_queue=1) as deaf:
            deaf.recv()
            channels = json.loads(deaf.recv())["channels"]
            wanted = [{"id": c["id"], "channelId": c["id"]} for c in channels]
            with Viewer(url, {STATE_TOPIC}) as viewer:
                deaf.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                time.sleep(0.2)
                began = time.monotonic()
                print(file=serving.stdin, flush=True)
                last = struct.pack("<d", rows(13)["device_time"][-1])  # decoding all takes 10 s
                seen = [last in message.raw for message in viewer.messages()]  # to the end
                assert any(seen)
            assert serving.wait(20) == 0
            assert time.monotonic() - began < 20


class Unlimited:
    """Shows every row."""

    def due(self) -> int:
        return 1

    def select(self, block: StructArray) -> tuple[StructArray, Any]:
        return block, np.zeros(len(block))


@pytest.mark.wire
def test_a_viewer_may_come_and_go_at_any_time() -> None:
    with FoxgloveLive(ROBOT, port=0) as live:
        for step in range(3):
            with Viewer(live.url, {"/hil/progress"}) as viewer:
                until(lambda: live._watched("/hil/progress"))
                live.notify({"kind": "progress", "step": step, "steps": 9})
                assert next(viewer.messages()).data["step"] == step
            until(lambda: not live._watched("/hil/progress"))


def refused(url: str) -> bool:
    """Return whether nobody listens any more."""
    try:
        connect(url, subprotocols=[PROTOCOL]).close()
    except ConnectionRefusedError:
        return True
    except (OSError, WebSocketException):
        pass
    return False


@pytest.mark.wire
def test_the_server_is_gone_when_it_was_stopped() -> None:
    live = FoxgloveLive(ROBOT, port=0)
    live.start()
    url = live.url
    with Viewer(url) as viewer:
        live.stop()
        assert list(viewer.messages()) == []
    assert live.url == ""
    # A busy computer may still be closing the port after the second that `stop` waits.
    end = time.monotonic() + 10
    while not refused(url):
        assert time.monotonic() < end
    live.notify({"kind": "state", "state": "done", "reason": ""})
    live.stop()


@pytest.mark.wire
def test_clients_can_only_watch() -> None:
    with FoxgloveLive(ROBOT, port=0) as live, Viewer(live.url) as viewer:
        assert viewer.info["capabilities"] == []


@pytest.mark.wire
def test_a_port_in_use_is_refused_by_name(free_port: int) -> None:
    with FoxgloveLive(ROBOT, port=free_port), pytest.raises(PluginError) as caught:
        FoxgloveLive(ROBOT, port=free_port).start()
    assert f"127.0.0.1, port {free_port}: " in caught.value.message
    assert "--live-port" in caught.value.hint


@pytest.mark.wire
def test_without_a_port_the_next_free_one_is_taken(
    free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "DEFAULT_PORT", free_port)
    with FoxgloveLive(ROBOT) as first, FoxgloveLive(ROBOT) as second:
        assert first.url == f"ws://127.0.0.1:{free_port}"
        assert second.url != first.url
        with Viewer(second.url) as viewer:
            assert STATE_TOPIC in viewer.channels


@pytest.mark.wire
def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(PluginError, match=r"cannot listen on 192\.0\.2\.1") as caught:
        FoxgloveLive(ROBOT, host="192.0.2.1", port=0).start()
    assert "--live-host" in caught.value.hint


@pytest.mark.wire
def test_without_the_extra_nothing_moves_and_the_remedy_is_told(
    tmp_path: Path,
) -> None:
    code = (
        "import sys; sys.modules['foxglove'] = None\n"
        f"sys.argv = ['hil', 'run', {str(DWELL)!r}, '--runs', {str(tmp_path / 'r')!r}, '--live']\n"
        "from hil.cli import main\nmain()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'pip install "hil[live]"' in done.stderr
    assert not (tmp_path / "r").exists()


@pytest.mark.wire
def test_a_view_for_others_comes_with_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    with live_view(lambda: ROBOT, True, 0, "0.0.0.0") as views:
        assert len(views) == 1
    assert "no password" in capsys.readouterr().err
    with live_view(lambda: ROBOT, True, 0, None):
        pass
    assert "no password" not in capsys.readouterr().err


@pytest.mark.wire
def test_nobody_asked_nothing_is_served() -> None:
    def unasked() -> Capabilities:
        raise AssertionError

    with live_view(unasked, False, None, None) as views:
        assert views == ()


@pytest.mark.wire
def test_a_resumed_run_is_shown_by_its_own_record(
    seen: tuple[Path, list[Message], str], tmp_path: Path
) -> None:
    can = recorded_capabilities(RunDirectory.open(seen[0]))
    assert can.joint_names[2] == "elbow_joint"
    assert (can.rate_hz, can.effort_kind, can.clock) == (125.0, "current", "virtual")
    (tmp_path / "start.json").write_text('{"hil_run": 1}')
    with pytest.raises(DataError, match="robot"):
        recorded_capabilities(RunDirectory.open(tmp_path))


# The layout for viewers: what it shows is what is served, and it has the structure they load


layouts = pytest.importorskip("foxglove.layouts")
DOCUMENT: dict[str, Any] = json.loads(LAYOUT.read_text("utf-8"))
PANELS: dict[str, dict[str, Any]] = DOCUMENT["configById"]
CONFIGS = {
    "Plot": layouts.PlotConfig,
    "StateTransitions": layouts.StateTransitionsConfig,
    "Indicator": layouts.IndicatorConfig,
    "Gauge": layouts.GaugeConfig,
    "RosOut": layouts.LogConfig,  # the log panel has kept its old name
    "RawMessages": layouts.RawMessagesConfig,
}
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}


def leaves(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
        return
    assert set(node) == {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    yield from leaves(node["first"])
    yield from leaves(node["second"])


def paths(value: Any) -> Iterator[str]:
    """Every message path in a panel's configuration: texts that begin with a slash."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from paths(item)
    elif isinstance(value, str) and value.startswith("/"):
        yield value


def test_it_has_the_parts_of_an_exported_layout() -> None:
    assert set(DOCUMENT) == {
        "configById", "globalVariables", "userNodes", "playbackConfig", "layout",
    }  # fmt: skip
    assert DOCUMENT["playbackConfig"] == {"speed": 1}


def test_every_panel_is_in_the_tree_once() -> None:
    found = list(leaves(DOCUMENT["layout"]))
    assert len(found) == len(set(found))
    assert set(found) == set(PANELS)


@pytest.mark.parametrize("panel", PANELS)
def test_panels_are_of_a_known_type_and_say_only_what_it_knows(panel: str) -> None:
    kind, bang, name = panel.partition("!")
    assert bang
    assert name
    known = {*CONFIGS[kind]()._to_dict(), *TITLES}
    assert set(PANELS[panel]) <= known
    for series in PANELS[panel].get("paths", []):
        of = layouts.PlotSeries if kind == "Plot" else layouts.StateTransitionsSeries
        assert set(series) <= set(of()._to_dict())
        assert series["timestampMethod"] == "receiveTime"


@pytest.mark.parametrize("path", sorted({path for p in PANELS.values() for path in paths(p)}))
def test_every_path_leads_to_something_that_is_served(path: str) -> None:
    robot = Capabilities(tuple(f"j{i + 1}" for i in range(6)), 125.0, "current")
    match = re.fullmatch(r"(/[a-z_/]+)(?:\.(\w+))?(?:\[(\d)\])?", path)
    assert match is not None
    topic, field, index = match.groups()
    if topic == PROGRESS_TOPIC:
        assert field is None or field in PROGRESS_SCHEMA["properties"]
        return
    text = RobotTopics(robot).schemas[topic].text
    if field is not None:
        assert re.search(rf"^float64\[6\] {field}\b", text, re.MULTILINE)
        assert 0 <= int(index) < 6


# Where a run stands, and what its events say


def standing(*events: dict[str, Any]) -> Standing:
    out = Standing()
    for event in events:
        out.take(event)
    return out


def said(*events: dict[str, Any]) -> tuple[int, str] | None:
    return message_of(events[-1], standing(*events))


def test_keys_an_event_lacks_keep_their_value() -> None:
    run = standing(
        {"kind": "progress", "step": 3, "steps": 9, "doing": "dwell", "gaps": 2},
        {"kind": "progress", "step": 4},
    )
    assert (run.step, run.steps, run.doing, run.gaps) == (4, 9, "dwell", 2)


def test_times_that_are_not_known_yet_change_nothing() -> None:
    run = standing({"kind": "progress", "device_s": float("nan"), "steps": 9, "step": 0})
    json.dumps(run.snapshot(), allow_nan=False)
    assert run.device_s == 0.0


def test_waiting_for_an_answer_is_no_progress() -> None:
    times = {"steps": 9, "duration_s": 100.0, "wall_s": 0.1}
    run = standing(
        {"kind": "progress", "step": 1, "device_s": 10.0, **times},
        {"kind": "prompt", "text": "Mount the disc", "answered_by": ""},
        {"kind": "progress", "step": 1, "device_s": 70.0, **times},
        {"kind": "prompt", "text": "Mount the disc", "answered_by": "ann"},
        {"kind": "progress", "step": 2, "device_s": 75.0, **times},
    )
    assert run.share == pytest.approx(0.15)
    assert run.prompt == ""


def test_prompts_have_numbers_their_own_or_counted() -> None:
    asked: list[dict[str, Any]] = [{"kind": "prompt", "text": "Mount it", "answered_by": ""}] * 2
    answered = {"kind": "prompt", "text": "Mount it", "answered_by": "ann"}
    assert standing(asked[0], answered, asked[0]).asked == 2
    assert standing(asked[0] | {"asked": 3}, answered).asked == 3  # some were not heard of
    assert standing(asked[0]).snapshot()["asked"] == 1


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({"kind": "stage", "stage": "planning"}, (INFO, "planning")),
        ({"kind": "state", "state": "running", "reason": ""}, (INFO, "running")),
        ({"kind": "state", "state": "paused", "reason": "hot"}, (WARNING, "paused: hot")),
        ({"kind": "state", "state": "stopping", "reason": "trip"}, (ERROR, "stopping: trip")),
        ({"kind": "state", "state": "stopping", "reason": ""}, (INFO, "stopping")),
        ({"kind": "prompt", "text": "Mount", "answered_by": ""}, (WARNING, "asking: Mount")),
        ({"kind": "prompt", "text": "Disc", "answered_by": "ann"}, (INFO, "answered by ann: Disc")),
        (
            {"kind": "step", "step": 4, "steps": 9, "doing": "dwell", "pose": 2, "load": 0},
            (DEBUG, "step 5/9 dwell, pose 2"),
        ),
        (
            {"kind": "step", "step": 0, "steps": 9, "doing": "payload", "load": 1},
            (DEBUG, "step 1/9 payload, load 1"),
        ),
        ({"kind": "progress", "step": 4, "steps": 9}, None),
    ],
)  # fmt: skip
def test_events_say_what_they_mean_and_how_bad_it_is(
    event: dict[str, Any], expected: tuple[int, str] | None
) -> None:
    assert said(event) == expected


def test_a_completed_run_ends_without_alarm() -> None:
    step = {"kind": "step", "step": 8, "steps": 9}
    assert said(step, {"kind": "state", "state": "done", "reason": "completed"}) == (
        INFO,
        "done: completed",
    )


# Which rows a viewer is shown


class Wall:
    """A wall clock that goes on when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def block(begin: float, n: int, rate_hz: float) -> StructArray:
    rows = np.zeros(n, state_dtype(6))
    rows["device_time"] = begin + np.arange(n) / rate_hz
    return rows


@pytest.mark.parametrize(
    ("every_s", "rows", "rate_hz"),
    [(0.008, 1, 125), (0.032, 16, 500), (0.2, 100, 500), (0.0005, 16, 125), (1.0, 8000, 8000)],
)
def test_at_most_60_rows_a_second_of_wall_time(every_s: float, rows: int, rate_hz: float) -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    shown = 0
    for i in range(int(10 / every_s)):
        wall.now += every_s
        shown += len(decimation.select(block(i * rows / rate_hz, rows, rate_hz))[0])
    assert shown <= 60 * 10 + AT_ONCE
    # As many as there may be: fewer only where blocks come too seldom, or bring too few rows.
    assert shown >= 0.8 * min(60 * 10, AT_ONCE * 10 / every_s, rows * 10 / every_s)


def test_the_newest_row_is_shown_and_the_others_are_evenly_spread() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    rows = block(5.0, 50, 500)
    chosen, _ = decimation.select(rows)
    assert chosen["device_time"][-1] == rows["device_time"][-1]
    assert np.ptp(np.diff(chosen["device_time"])) < 1e-9
    assert 4 <= len(chosen) <= 7


def test_ages_follow_the_device_clock_of_a_real_robot() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    chosen, age = decimation.select(block(0.0, 12, 125))
    assert age == pytest.approx(chosen["device_time"][-1] - chosen["device_time"])


def test_a_clock_that_runs_ahead_is_squeezed_into_the_time_that_has_passed() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    _, age = decimation.select(block(0.0, 1250, 125))  # 10 s at once
    assert 0.08 < age[0] < 0.1  # after what was shown before
    assert (np.diff(age) < 0).all()
    assert age[-1] == 0


def test_nothing_is_due_at_once_again() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 1.0
    decimation.select(block(0.0, 100, 500))
    assert decimation.due() == 0
    assert len(decimation.select(block(1.0, 100, 500))[0]) == 0
