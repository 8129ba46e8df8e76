"""Where channels live, and who may host them."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

import pytest

from hil.can import channels
from hil.can.channels import named_channels, socket_path
from hil.can.hub import Hub
from hil.core.errors import PluginError
from tests.support.canbus_parts import can_channel, raw_end  # noqa: F401


@pytest.fixture
def above(can_channel: str, monkeypatch: pytest.MonkeyPatch) -> Path:  # noqa: F811
    """The folder in which the runtime folder will be."""
    folder = Path(can_channel).parent
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def test_a_name_is_a_socket_in_a_folder_of_this_user_alone(above: Path) -> None:
    with Hub("can0") as hub:
        assert hub.path == above / f"hil-can-{os.getuid()}" / "can0.sock"
        assert stat.S_IMODE(hub.path.parent.stat().st_mode) == 0o700
        assert stat.S_IMODE(hub.path.stat().st_mode) == 0o600
        assert named_channels() == ["can0"]
    assert named_channels() == []


def test_without_a_runtime_folder_the_temporary_one_is_used(
    above: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(channels.tempfile, "gettempdir", lambda: str(above))
    assert socket_path("can1").parent.parent == above


@pytest.mark.parametrize("name", ["", "../can0", "a/b", ".hidden", "can 0", "can\x00", "-x"])
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(PluginError, match="no channel"):
        socket_path(name)


def test_a_path_too_long_for_a_socket_is_refused() -> None:
    with pytest.raises(PluginError, match="107 bytes"):
        socket_path("/tmp/" + 120 * "x")


def test_a_folder_others_can_get_into_is_refused(above: Path) -> None:
    folder = above / f"hil-can-{os.getuid()}"
    folder.mkdir(mode=0o755)
    with pytest.raises(PluginError, match="other users can get into") as raised:
        Hub("can0")
    assert f"chmod 700 {folder}" in str(raised.value)


def test_a_folder_of_another_user_is_refused(above: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (above / f"hil-can-{os.getuid() + 1}").mkdir(mode=0o700)
    uid = os.getuid() + 1
    monkeypatch.setattr(channels.os, "getuid", lambda: uid)
    with pytest.raises(PluginError, match="belongs to another user"):
        Hub("can0")


def test_a_link_in_place_of_the_folder_is_refused(above: Path) -> None:
    (above / "elsewhere").mkdir(mode=0o700)
    (above / f"hil-can-{os.getuid()}").symlink_to(above / "elsewhere")
    with pytest.raises(PluginError, match="is none"):
        Hub("can0")


def test_a_channel_in_a_missing_folder_is_refused(above: Path) -> None:
    with pytest.raises(PluginError, match="cannot be used: No such file"):
        Hub(above / "missing" / "can.sock")


def test_one_hub_hosts_a_channel_and_the_next_is_told_which(can_channel: str) -> None:  # noqa: F811
    with Hub(can_channel):
        with pytest.raises(PluginError, match="taken: pid ") as raised:
            Hub(can_channel)
        assert str(os.getpid()) in str(raised.value)
        raw_end(can_channel).close()  # still there
    Hub(can_channel).close()


def test_the_socket_of_a_dead_hub_is_replaced(can_channel: str) -> None:  # noqa: F811
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
        left.bind(can_channel)
    with Hub(can_channel):
        raw_end(can_channel).close()


def test_what_is_no_socket_is_left_alone(can_channel: str) -> None:  # noqa: F811
    Path(can_channel).write_text("precious")
    with pytest.raises(PluginError, match="no socket"):
        Hub(can_channel)
    assert Path(can_channel).read_text() == "precious"
    Path(can_channel).unlink()
    Hub(can_channel).close()  # and nothing is held any more


def test_a_closed_hub_leaves_nothing_behind(can_channel: str) -> None:  # noqa: F811
    hub = Hub(can_channel)
    hub.close()
    hub.close()
    assert list(Path(can_channel).parent.iterdir()) == []
