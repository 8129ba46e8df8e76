"""Reading of ROS 2 bags (sqlite3 or mcap): JointState messages, with joints identified by name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray, IntArray, did_you_mean, look_into, plugins
from hil.importers.foreign_samples import ForeignSamples
from hil.importers.import_map import ImportMap

JOINT_STATE = "sensor_msgs/msg/JointState"
METADATA = "metadata.yaml"
FIELDS = {"q": "position", "qd": "velocity", "effort": "effort"}


def read_bag(path: Path, layout: ImportMap) -> ForeignSamples:
    """Return the samples in the JointState messages of a bag.

    The bag is a folder, a .db3 file or an .mcap file.

    The order of the joints in a message depends on the driver (elbow first or alphabetical order is
    common), so that `joint_names` of the map defines the order of the result.

    Raises:
        DataError: The bag cannot be read, has no JointState topic of the map, or lacks a joint.
        PluginError: The package `rosbags` is not installed.
    """
    wanted = [name for name in layout.quantities() if name in FIELDS]
    stamps: list[float] = []
    samples: dict[str, list[FloatArray]] = {name: [] for name in wanted}
    problems: dict[int, str] = {}
    orders: dict[tuple[str, ...], IntArray | str] = {}
    for row, (logged, message) in enumerate(_messages(path, layout.topic)):
        stamp = message.header.stamp
        seconds = stamp.sec + 1e-9 * stamp.nanosec if layout.stamp == "header" else 1e-9 * logged
        stamps.append(seconds)
        names = tuple(message.name)
        order = orders.setdefault(names, _order(names, layout.joint_names))
        for name in wanted:
            values, why = _values(message, FIELDS[name], order, len(names), layout.n_joints)
            samples[name].append(values)
            if why:
                problems.setdefault(row, why)
    if not stamps:
        raise DataError(
            f"{path}: no messages under {layout.topic}",
            hint="correct topic in the map; ros2 bag info lists the topics",
        )
    _require_joints(orders, path)
    columns = {name: np.array(rows) for name, rows in samples.items()}
    columns["t"] = np.array(stamps)
    return ForeignSamples(columns, np.arange(1, len(stamps) + 1), "message", problems)


def _messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise plugins.not_installed("reading ROS 2 bags", ["rosbags"], "bags") from error
    try:
        with AnyReader(
            [_bag_of(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)
        ) as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            if not connections:
                topics = sorted({c.topic for c in reader.connections})
                raise DataError(f"{path} has no topic {topic}", hint=did_you_mean(topic, topics))
            if connections[0].msgtype != JOINT_STATE:
                raise DataError(
                    f"{topic} in {path} contains {connections[0].msgtype}, not {JOINT_STATE}",
                    hint="set topic in the map to a topic with joint states",
                )
            for connection, logged, data in reader.messages(connections):
                yield logged, reader.deserialize(data, connection.msgtype)
    except (AnyReaderError, OSError) as error:
        raise DataError(
            f"cannot read {path} as a ROS 2 bag: {error}",
            hint="is it a folder with metadata.yaml, or one .db3 or .mcap file?",
        ) from error


def _bag_of(path: Path) -> Path:
    """Return the folder of the bag that contains the file `path`, or `path` itself.

    A `metadata.yaml` next to a file is used only if it lists the file: one folder can contain files
    of several bags, and a different bag would otherwise be read.
    """
    try:
        about = look_into((path.parent / METADATA).read_bytes())
        listed = about["rosbag2_bagfile_information"]["relative_file_paths"]
        whole = path.name in listed and all((path.parent / name).is_file() for name in listed)
    except (OSError, ValueError, LookupError, TypeError):
        return path  # the metadata file is missing or is not from a bag
    return path.parent if whole else path


def _order(names: tuple[str, ...], wanted: tuple[str, ...]) -> IntArray | str:
    """Return the position of each joint of the map in a message, or a text if one is missing."""
    missing = [name for name in wanted if name not in names]
    if missing:
        return f"has no joint {missing[0]!r} (it lists {', '.join(names) or 'none'})"
    return np.array([names.index(name) for name in wanted], dtype=np.int64)


def _values(
    message: Any, field: str, order: IntArray | str, names: int, n: int
) -> tuple[FloatArray, str]:
    unknown = np.full(n, np.nan)
    if isinstance(order, str):
        return unknown, order
    values = np.asarray(getattr(message, field), dtype=np.float64)
    if len(values) != names:
        return unknown, f"has {len(values)} values of {field} for {names} joints"
    return values[order], ""


def _require_joints(orders: dict[tuple[str, ...], IntArray | str], path: Path) -> None:
    """Raise if no message contains the joints of the map.

    Messages of other devices can lack these joints.
    """
    wrong = [why for why in orders.values() if isinstance(why, str)]
    if len(wrong) == len(orders):
        raise DataError(
            f"{path}: no message lists the map's joints; the first {wrong[0]}",
            hint="correct joint_names in the map",
        )
