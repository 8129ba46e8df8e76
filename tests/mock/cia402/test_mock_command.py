"""`hil mock can`: options, the data sheet, the truth, and what is said when something cannot be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from canopen.objectdictionary import import_od

from hil.arms import load_arm
from hil.core.errors import PluginError, SpecError
from hil_mock_robot.cia402.bus import HubEnd, end_of, side_path
from hil_mock_robot.cia402.mock import main, nodes_of, parser_of
from hil_mock_robot.server.options import mounted_of, pose_of

ARM = load_arm("lab6")


def test_without_options_it_is_lab6_on_can0() -> None:
    given = parser_of().parse_args([])
    assert (given.model, given.channel, given.interface) == ("lab6", "can0", "hil_unix")
    assert given.bitrate is None


def test_nodes_are_numbered_from_one_unless_somebody_says() -> None:
    assert nodes_of((), ARM, 127) == (1, 2, 3, 4, 5, 6)
    assert nodes_of((11, 12, 13, 14, 15, 16), ARM, 127) == (11, 12, 13, 14, 15, 16)


@pytest.mark.parametrize(
    ("nodes", "master_id"),
    [((1, 2, 3), 127), ((1, 1, 2, 3, 4, 5), 127), ((0, 1, 2, 3, 4, 5), 127), ((), 3), ((), 128)],
)
def test_nodes_that_cannot_share_a_bus_are_refused(nodes: Sequence[int], master_id: int) -> None:
    with pytest.raises(SpecError) as refused:
        nodes_of(nodes, ARM, master_id)
    assert refused.value.hint


@pytest.mark.parametrize("degrees", [(1, 2, 3), (999, 0, 0, 0, 0, 0), (math.nan,) * 6])
def test_what_is_no_pose_of_the_arm_is_refused(degrees: Sequence[float]) -> None:
    with pytest.raises(SpecError, match="no pose"):
        pose_of(degrees, ARM)


def test_a_pose_is_in_degrees() -> None:
    assert np.degrees(pose_of((10, 20, -30, 40, 50, 60), ARM)) == pytest.approx(
        [10, 20, -30, 40, 50, 60]
    )


def test_what_is_mounted_has_a_mass() -> None:
    assert mounted_of(None) is None
    mounted = mounted_of([2.0, 0.0, 0.0, 0.05])
    assert mounted is not None
    assert (mounted.mass, mounted.com) == (2.0, (0.0, 0.0, 0.05))
    with pytest.raises(SpecError):
        mounted_of([-1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "given",
    [
        ("hil_unix", None, 10.0),
        ("socketcan", 1e6, 10.0),
        ("hil_unix", 1e6, 0.0),
        ("hil_unix", 1e6, math.nan),
        ("hil_unix", -1.0, None),
        ("hil_unix", math.inf, None),
    ],
)
def test_a_wire_that_cannot_be_is_refused(
    given: tuple[str, float | None, float | None], tmp_path: Path
) -> None:
    interface, bitrate, speed = given
    with pytest.raises(SpecError) as refused:
        end_of(interface, str(tmp_path / "can.sock"), bitrate, speed)
    assert refused.value.hint


@pytest.mark.parametrize(("speed", "times"), [(None, 1), (10.0, 10)])
def test_the_modelled_wire_goes_at_the_pace_of_the_master(
    speed: float | None, times: int, tmp_path: Path
) -> None:
    end = end_of("hil_unix", str(tmp_path / "can.sock"), 1e6, speed)
    end.send(0x181, bytes(8))
    assert isinstance(end, HubEnd)
    assert end.hub.wire is not None
    assert end.hub.wire.busy_s == pytest.approx(135e-6 / times)
    end.close()


def test_the_side_channel_lies_beside_the_bus(tmp_path: Path) -> None:
    assert side_path("hil_unix", str(tmp_path / "a.sock")) == str(tmp_path / "a.side")
    assert side_path("virtual", "x").endswith("virtual-x.side")


def test_an_interface_that_is_not_there_is_named() -> None:
    with pytest.raises(PluginError, match="nonsense channel can0") as refused:
        end_of("nonsense", "can0")
    assert "hil_unix" in refused.value.hint


def test_a_bus_is_let_go_when_an_option_cannot_be(tmp_path: Path) -> None:
    channel = str(tmp_path / "can.sock")
    assert main(["--channel", channel, "--nodes", "1", "2"]) == 2
    end_of("hil_unix", channel).close()


def test_the_data_sheet_can_be_had_as_a_file(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    assert main(["--eds", str(path)]) == 0
    dictionary = import_od(str(path), 5)
    assert dictionary["Statusword"].index == 0x6041
    assert dictionary[0x1400][1].default == 0x4000_0205


def test_a_data_sheet_that_cannot_be_written_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--eds", str(tmp_path / "nowhere" / "drive.eds")]) == 7
    assert "cannot write" in capsys.readouterr().err
