"""MATLAB files, ROS 2 bags and files with one value per line."""

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

from hil.core.errors import DataError
from hil.importers import ImportMap, import_recording
from hil.importers.sources import load_source

ROWS = 40
T = np.arange(ROWS) * 0.004
Q = np.column_stack([np.sin(T), np.cos(T), T])
EFFORT = np.column_stack([T, -T, T**2])


def layout(format_, columns, **changes):
    return ImportMap.model_validate(
        {
            "hil_map": 1,
            "format": format_,
            "robot": "three-link",
            "joint_names": ["base", "shoulder", "elbow"],
            "effort_kind": "torque",
            "columns": columns,
        }
        | changes
    )


def imported(path, map_, tmp_path, **options):
    out = tmp_path / "out.mcap"
    report = import_recording(path, map_file=map_, out=out, **options)
    return load_source(out), report


MAT = {
    "t": {"columns": "rec.time"},
    "q": {"columns": "rec.pos_deg", "unit": "deg"},
    "effort": {"columns": "rec.motor_nm", "unit": "N·m", "scale": [100, 200, 50]},
}


def mat_file(tmp_path, q=Q):
    path = tmp_path / "run.mat"
    record = {"time": T, "pos_deg": np.degrees(q).T, "motor_nm": EFFORT.T, "name": "x"}
    savemat(path, {"rec": record, "other": 3})
    return path


def test_fields_of_a_matlab_struct_with_joints_along_rows(tmp_path) -> None:
    data, _ = imported(mat_file(tmp_path), layout("mat", MAT), tmp_path)
    assert data["q"] == pytest.approx(Q)
    assert data["effort"] == pytest.approx(EFFORT * [100, 200, 50])
    assert data["t"] == pytest.approx(T)


def test_matlab_joints_can_be_taken_one_by_one(tmp_path) -> None:
    one_by_one = {"columns": [f"rec.pos_deg[{j}]" for j in (3, 1, 2)], "unit": "deg"}
    data, _ = imported(mat_file(tmp_path), layout("mat", {**MAT, "q": one_by_one}), tmp_path)
    assert data["q"] == pytest.approx(Q[:, [2, 0, 1]])


def test_bad_samples_of_a_matlab_file_are_counted_from_one(tmp_path) -> None:
    q = np.array(Q)
    q[16, 1] = np.nan
    with pytest.raises(DataError, match="sample 17: q of joint 2 is nan"):
        imported(mat_file(tmp_path, q), layout("mat", MAT), tmp_path)


def test_missing_matlab_variable_comes_with_a_guess(tmp_path) -> None:
    wrong = {**MAT, "t": {"columns": "rec.tme"}}
    with pytest.raises(DataError, match=r"no variable 'rec\.tme'") as caught:
        imported(mat_file(tmp_path), layout("mat", wrong), tmp_path)
    assert "'time'" in caught.value.hint


def test_matlab_7_3_is_refused_with_the_way_to_convert(tmp_path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x00" * 400)
    with pytest.raises(DataError, match=r"7\.3") as caught:
        imported(path, layout("mat", MAT), tmp_path)
    assert "-v7" in caught.value.hint


BAG = {
    "q": {"unit": "rad"},
    "qd": {"unit": "rad/s"},
    "effort": {"unit": "N·m"},
}


LOGGED = 1_700_000_100_000_000_000


def bag(tmp_path, plugin=StoragePlugin.SQLITE3, orders=None, spoil=()):
    """Joint states elbow first, with a gripper among them."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    JointState = store.types["sensor_msgs/msg/JointState"]
    Header = store.types["std_msgs/msg/Header"]
    Time = store.types["builtin_interfaces/msg/Time"]
    path = tmp_path / "bag"
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/joint_states", JointState.__msgtype__, typestore=store)
        for k in range(ROWS):
            names = (orders or {}).get(k, ["elbow", "gripper", "base", "shoulder"])
            at = {"base": 0, "shoulder": 1, "elbow": 2}
            q = np.array([Q[k, at[n]] if n in at else 99.0 for n in names])
            effort = np.array([EFFORT[k, at[n]] if n in at else 99.0 for n in names])
            stamp = Time(sec=1700000000, nanosec=round(k * 4e6))
            message = JointState(
                header=Header(stamp=stamp, frame_id=""),
                name=names,
                position=q if k not in spoil else q[:2],
                velocity=2 * q,
                effort=effort,
            )
            data = store.serialize_cdr(message, JointState.__msgtype__)
            writer.write(topic, LOGGED + round(k * 4e6), data)
    return path


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_joints_of_a_bag_are_matched_by_name(tmp_path, plugin) -> None:
    data, _ = imported(bag(tmp_path, plugin), layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)
    assert data["qd"] == pytest.approx(2 * Q)
    assert data["effort"] == pytest.approx(EFFORT)


def test_order_of_the_joints_may_change_within_a_bag(tmp_path) -> None:
    orders = {k: ["base", "elbow", "shoulder"] for k in range(0, ROWS, 3)}
    data, _ = imported(bag(tmp_path, orders=orders), layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


def test_bag_time_is_the_headers_or_the_logs(tmp_path) -> None:
    path = bag(tmp_path)
    data, _ = imported(path, layout("ros2bag", BAG), tmp_path)
    assert data["t"] == pytest.approx(1.7e9 + T, abs=1e-6)
    logged = layout("ros2bag", BAG, stamp="log")
    import_recording(path, map_file=logged, out=tmp_path / "log.mcap")
    assert load_source(tmp_path / "log.mcap")["t"] == pytest.approx(1e-9 * LOGGED + T, abs=1e-6)


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_file_inside_a_bag_may_be_named_instead_of_its_folder(tmp_path, plugin) -> None:
    (file,) = (f for f in bag(tmp_path, plugin).iterdir() if f.suffix in (".db3", ".mcap"))
    data, _ = imported(file, layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_bag_file_without_its_folder_is_enough(tmp_path, plugin) -> None:
    (file,) = (f for f in bag(tmp_path, plugin).iterdir() if f.suffix in (".db3", ".mcap"))
    alone = file.rename(tmp_path / file.name)
    data, _ = imported(alone, layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


UNRELATED = {
    "of nothing": "author: somebody\n",
    "no mapping": "3\n",
    "no YAML": "[: {",
    "no files": "rosbag2_bagfile_information: {relative_file_paths: 3}\n",
    "of a bag that is gone": "rosbag2_bagfile_information:\n  relative_file_paths: [other.db3]\n",
}


@pytest.mark.parametrize("metadata", UNRELATED.values(), ids=UNRELATED)
def test_bag_file_next_to_an_unrelated_metadata_file_is_enough(tmp_path, metadata) -> None:
    (file,) = bag(tmp_path).glob("*.db3")
    alone = file.rename(tmp_path / "alone.db3")
    (tmp_path / "metadata.yaml").write_text(metadata, "utf-8")
    data, _ = imported(alone, layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


def test_the_file_named_is_read_and_not_the_bag_it_lies_in(tmp_path) -> None:
    """Where a bag lies complete in the same folder it must not be taken for the file."""
    (tmp_path / "longer").mkdir()
    (file,) = bag(tmp_path / "longer").glob("*.db3")
    here = bag(tmp_path, orders={k: ["gripper"] for k in range(ROWS)})  # none of our joints
    data, _ = imported(file.rename(here / "named.db3"), layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


def test_one_file_of_a_bag_whose_others_are_missing_is_read_by_itself(tmp_path) -> None:
    path = bag(tmp_path)
    (file,) = path.glob("*.db3")
    text = (path / "metadata.yaml").read_text("utf-8")
    (path / "metadata.yaml").write_text(
        text.replace(f"- {file.name}", f"- {file.name}\n  - gone.db3", 1)
    )
    data, _ = imported(file, layout("ros2bag", BAG), tmp_path)
    assert data["q"] == pytest.approx(Q)


def test_messages_of_other_devices_and_short_ones_are_bad_rows(tmp_path) -> None:
    path = bag(tmp_path, orders={5: ["gripper"]}, spoil=[11])
    with pytest.raises(DataError, match="2 of 40") as caught:
        imported(path, layout("ros2bag", BAG), tmp_path)
    assert caught.match("message 6: has no joint 'base'")
    assert caught.match("message 12: has 2 values of position for 4 joints")


def test_bag_without_our_joints_lists_those_it_has(tmp_path) -> None:
    map_ = layout("ros2bag", BAG, joint_names=["j1", "j2", "j3"])
    with pytest.raises(DataError, match="elbow, gripper, base, shoulder"):
        imported(bag(tmp_path), map_, tmp_path)


def test_missing_topic_comes_with_a_guess(tmp_path) -> None:
    map_ = layout("ros2bag", BAG, topic="/joint_state")
    with pytest.raises(DataError, match="no topic /joint_state") as caught:
        imported(bag(tmp_path), map_, tmp_path)
    assert "/joint_states" in caught.value.hint


INTERLEAVED = {
    "t": {"file": "time.txt"},
    "q": {"file": "q.txt", "unit": "rad"},
    "effort": {"file": "tau.txt", "unit": "N·m"},
}


def interleaved(tmp_path):
    folder = tmp_path / "panda"
    folder.mkdir()
    for name, values in (("time", T), ("q", Q), ("tau", EFFORT)):
        (folder / f"{name}.txt").write_text("\n".join(f"{v:.12g}" for v in values.ravel()) + "\n")
    return folder


def test_interleaved_files_are_read_from_their_folder(tmp_path) -> None:
    data, _ = imported(interleaved(tmp_path), layout("interleaved", INTERLEAVED), tmp_path)
    assert data["q"] == pytest.approx(Q)
    assert data["effort"] == pytest.approx(EFFORT)


def test_bad_value_of_an_interleaved_file_is_named_by_file_and_line(tmp_path) -> None:
    folder = interleaved(tmp_path)
    lines = (folder / "q.txt").read_text().splitlines()
    lines[13] = "##"
    (folder / "q.txt").write_text("\n".join(lines))
    with pytest.raises(DataError, match=r"sample 5: q\.txt line 14 is not a number: ##"):
        imported(folder, layout("interleaved", INTERLEAVED), tmp_path)


def test_interleaved_file_that_ends_within_a_sample_can_be_repaired(tmp_path) -> None:
    folder = interleaved(tmp_path)
    lines = (folder / "tau.txt").read_text().splitlines()
    (folder / "tau.txt").write_text("\n".join(lines[:-2]))
    _, report = imported(folder, layout("interleaved", INTERLEAVED), tmp_path, drop_bad_rows=True)
    assert (report["samples"], report["dropped_samples"]) == (ROWS - 1, [ROWS])


def test_quantities_from_several_csv_files_stand_side_by_side(tmp_path) -> None:
    np.savetxt(tmp_path / "pos.csv", Q, delimiter=",")
    np.savetxt(tmp_path / "cur.csv", EFFORT[:-1], delimiter=",")
    map_ = layout(
        "csv",
        {
            "t": {"rate_hz": 250},
            "q": {"file": "pos.csv", "columns": "1:3", "unit": "rad"},
            "effort": {"file": "cur.csv", "columns": "1:3", "unit": "N·m"},
        },
    )
    data, report = imported(tmp_path / "pos.csv", map_, tmp_path, drop_bad_rows=True)
    assert report["dropped_lines"] == [ROWS]
    assert data["effort"] == pytest.approx(EFFORT[:-1])
    assert data["t"] == pytest.approx(T[:-1])
