"""Recording and reading MCAP in blocks: our writer and our columnar reader against their peers."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from hil.core.typing import StructArray
from hil.recording import McapWriter, read_topic
from hil.robot.state import STATE_TOPIC, Topic, state_topic

RATE_HZ = 500.0
MESSAGES, QUICK_MESSAGES = 600_000, 30_000
_ROWS_PER_FLUSH = 50
"""What the recorder flushes every 0.1 s at 500 Hz."""


def run(quick: bool = False) -> dict[str, Any]:
    """Write a recording as the recorder does, then read it three ways; CPU seconds.

    Args:
        quick: Use 30,000 messages instead of 600,000.
    """
    topic = state_topic(6, RATE_HZ, clock="controller", effort_unit="A")
    rows = synthetic_rows(topic, QUICK_MESSAGES if quick else MESSAGES)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "00.mcap"
        repeats = 3 if quick else 1
        write_s, _ = _cpu_seconds(lambda: _write(path, topic, rows))
        peer_s, _ = _cpu_seconds(lambda: _write_one_by_one(Path(folder) / "peer.mcap", topic, rows))
        columnar_s, read = _cpu_seconds(lambda: read_topic(path), repeats)
        frombuffer_s, viewed = _cpu_seconds(lambda: _iterate_and_view(path, topic), repeats)
        decoder_s, decoded = _cpu_seconds(lambda: _decode_all(path, topic, len(rows)), repeats)
        size = path.stat().st_size
    for name, got in (("columnar", read), ("iterator", viewed), ("decoder", decoded)):
        if got.tobytes() != rows.tobytes():
            raise AssertionError(f"the {name} reader did not give back what was written")
    return {
        "name": "mcap",
        "figures": {
            "messages": len(rows),
            "write_us_per_message": 1e6 * write_s / len(rows),
            "mcap_writer_us_per_message": 1e6 * peer_s / len(rows),
            "bytes_per_message": size / len(rows),
            "columnar_read_s": columnar_s,
            "iterator_frombuffer_s": frombuffer_s,
            "iterator_ros2_decoder_s": decoder_s,
        },
        "ratios": {
            "write_vs_mcap_writer": peer_s / write_s,
            "columnar_vs_ros2_decoder": decoder_s / columnar_s,
            "columnar_vs_iterator_frombuffer": frombuffer_s / columnar_s,
        },
    }


def synthetic_rows(topic: Topic, count: int) -> StructArray:
    """(count,) state rows as a moving arm gives them: smooth commands, noisy measurements."""
    rng = np.random.default_rng(0)
    rows = topic.blank(count)
    rows["device_time"] = np.arange(count) / RATE_HZ
    late = np.minimum(rng.exponential(2e-4, count), 1.5e-3)
    rows["host_time"] = 1.8e9 + rows["device_time"] + late
    phase = rows["device_time"][:, None] * np.arange(1, 7) * 0.3
    for quantity, order in (("q_target", 0), ("qd_target", 1), ("qdd_target", 2)):
        rows[quantity] = np.sin(phase + order * np.pi / 2)
    for quantity in ("q", "qd", "effort"):
        rows[quantity] = np.sin(phase) + rng.normal(0.0, 1e-3, phase.shape)
    rows["temperature"] = np.round(30 + rows["device_time"][:, None] / 600, 1)
    rows["segment"] = np.arange(count) // 1000
    return rows


def _cpu_seconds(work: Callable[[], Any], repeats: int = 1) -> tuple[float, Any]:
    """Least CPU time [s] of some repeats, and the result."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        seconds.append(time.process_time() - start)
    return min(seconds), result


def _write(path: Path, topic: Topic, rows: StructArray) -> None:
    names = [f"joint_{i}" for i in range(6)]
    with McapWriter(path, [topic], joint_names=names) as writer:
        for begin in range(0, len(rows), _ROWS_PER_FLUSH):
            writer.write(STATE_TOPIC, rows[begin : begin + _ROWS_PER_FLUSH])
            writer.flush(durable=False)


def _write_one_by_one(path: Path, topic: Topic, rows: StructArray) -> None:
    """Write the same with the writer of mcap, without the additional JointState messages."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(topic.schema_name, "ros2msg", topic.schema_text.encode())
        channel = writer.register_channel(topic.name, "cdr", schema, topic.channel_metadata)
        times = (rows["host_time"] * 1e9).astype(np.int64).tolist()
        for number, (time_ns, row) in enumerate(zip(times, rows, strict=True)):
            writer.add_message(channel, time_ns, b"\0\1\0\0" + row.tobytes(), time_ns, number)
            if number % _ROWS_PER_FLUSH == _ROWS_PER_FLUSH - 1:
                writer.flush()  # type: ignore[no-untyped-call]
        writer.finish()  # type: ignore[no-untyped-call]


def _iterate_and_view(path: Path, topic: Topic) -> StructArray:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        messages = make_reader(file).iter_messages(topics=STATE_TOPIC, log_time_order=False)
        content = b"".join(message.data[4:] for _, _, message in messages)
    return np.frombuffer(content, topic.dtype)


def _decode_all(path: Path, topic: Topic, count: int) -> StructArray:
    """Read a ROS 2 recording into numpy in the usual way."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    rows = np.empty(count, topic.dtype)
    fields = attrgetter(*(topic.dtype.names or ()))
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for number, item in enumerate(reader.iter_decoded_messages(topics=STATE_TOPIC)):
            rows[number] = fields(item.decoded_message)
    return rows
