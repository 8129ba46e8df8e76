"""Options of a station file for an arm behind a TwinCAT PLC."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from hil.arms import load_arm
from hil.robot import Address, is_loopback
from hil_drivers.network import host_of, is_ip
from hil_drivers.option_checks import OptionChecks

RANGES = {
    "port": (1, 65535),
    "rate_hz": (10.0, 8000.0),
    "block_rows": (1, 4000),
    "chunk_bytes": (1024, 262_144),
    "late_s": (0.05, 5.0),
    "speed_share": (0.01, 1.0),
}
"""Minimum and maximum value of each option that is a number."""

_CHECKS = OptionChecks("twincat")

WHOLE = ("port", "block_rows", "chunk_bytes")
ADS_PORT = 48898
DEFAULT_PREFIX = "GVL_Hil"

_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass(frozen=True, slots=True)
class Options:
    """Options of one arm behind a TwinCAT PLC.

    Attributes:
        address: IP address or host name of the PLC, with the TCP port if it is not 48898.
        ams_net_id: AMS net id of the PLC. For a PLC on this computer the id is derived from the
            address, like the id of the mock.
        local_net_id: AMS net id of this computer; needed if the route on the PLC differs from the
            default of `pyads` (the address of this computer and `.1.1`).
        port: AMS port of the PLC's runtime.
        prefix: Name of the PLC's variable list that contains the variables of the contract.
        rate_hz: Rate of the PLC's task [Hz].
        block_rows: Number of rows for which a read waits, because one request takes about a
            millisecond.
        chunk_bytes: Maximum number of bytes read or written in one request.
        effort: Quantity measured by the drives: torque at the joint [N·m], or motor current [A].
        drive_gains_nm_a: Drive gains at the joints [N·m/A]; by default those of the arm's
            description.
        late_s: Time without new rows of the PLC after which a motion is ended [s].
        speed_share: Share of the arm's maximum joint speeds that motions can use.
    """

    address: str
    ams_net_id: str
    local_net_id: str = ""
    port: int = 851
    prefix: str = DEFAULT_PREFIX
    rate_hz: float = 1000.0
    block_rows: int = 100
    chunk_bytes: int = 65536
    effort: Literal["torque", "current"] = "torque"
    drive_gains_nm_a: tuple[float, ...] = ()
    late_s: float = 0.5
    speed_share: float = 1.0

    @property
    def resource(self) -> str:
        """Identifier of the PLC, independent of its address in the station file.

        A PLC accepts one TCP connection per computer, so two programs on one computer cannot drive
        two arms of the same PLC.
        """
        return f"ads://{self.ams_net_id}"

    @property
    def route(self) -> Address:
        """Address of the PLC; see `hil.robot.HasAddress`.

        An ADS router on this computer can forward to a real PLC. Only the AMS net id therefore
        shows whether the PLC is real.
        """
        here = is_loopback(self.host[0]) and self.ams_net_id.startswith("127.")
        return Address(f"{self.address} (AMS net id {self.ams_net_id})", real=not here)

    @property
    def host(self) -> tuple[str, int]:
        """Host and TCP port of the PLC's ADS server."""
        host, _, port = self.address.partition(":")
        return host, int(port or ADS_PORT)


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """Check the options of a station file and return the options of the arm.

    Args:
        given: Values in the station file, by option name.
        model: Name of a built-in arm.

    Raises:
        SpecError: An option is missing, unknown, or has an invalid value.
    """
    _CHECKS.require_known(given, [field.name for field in fields(Options)])
    for name, between in RANGES.items():
        if name in given:
            _CHECKS.number(name, given[name], between, whole=name in WHOLE)
    _CHECKS.choice("effort", given.get("effort", "torque"), ("torque", "current"))
    prefix = given.get("prefix", DEFAULT_PREFIX)
    if not isinstance(prefix, str) or not _NAME.fullmatch(prefix):
        raise _CHECKS.wrong_option(
            "prefix", prefix, f"name the PLC's variable list, such as {DEFAULT_PREFIX}"
        )
    address = _address(given.get("address"))
    return Options(
        **{
            **given,
            "address": address,
            "ams_net_id": _ams_net_id(given.get("ams_net_id"), address),
            "local_net_id": _local_net_id(given.get("local_net_id")),
            "drive_gains_nm_a": _gains(given.get("drive_gains_nm_a"), model),
        }
    )


def _address(value: Any) -> str:
    """Return the address of a PLC in normalized form."""
    written, _, port = value.strip().partition(":") if isinstance(value, str) else ("", "", "")
    host = host_of(written)
    if host and (not port or (port.isdigit() and 0 < int(port) < 65536)):
        return host if not port or int(port) == ADS_PORT else f"{host}:{int(port)}"
    hint = "give the IP address of the PLC"
    if value is None:
        raise _CHECKS.lacking("address", hint)
    raise _CHECKS.wrong_option("address", value, hint)


def _ams_net_id(value: Any, address: str) -> str:
    host = address.partition(":")[0]
    if value is None and is_ip(host) and ipaddress.ip_address(host).is_loopback:
        return f"{host}.1.1"
    hint = "six numbers such as 5.24.37.144.1.1: TwinCAT shows it under System, Routes"
    if value is None:
        raise _CHECKS.lacking("ams_net_id", hint)
    return _six_numbers("ams_net_id", value, hint)


def _local_net_id(value: Any) -> str:
    hint = "six numbers, those of the route to this computer on the PLC: System, Routes"
    return "" if value is None else _six_numbers("local_net_id", value, hint)


def _six_numbers(name: str, value: Any, hint: str) -> str:
    parts = value.strip().split(".") if isinstance(value, str) else []
    if len(parts) != 6 or not all(each.isdigit() and int(each) < 256 for each in parts):
        raise _CHECKS.wrong_option(name, value, hint)
    return ".".join(str(int(each)) for each in parts)


def _gains(value: Any, model: str) -> tuple[float, ...]:
    arm = load_arm(model)
    if value is None:
        return tuple(arm.drive_gains.tolist())
    name = "drive_gains_nm_a"
    each = _CHECKS.per_axis(name, value, arm.n_joints)
    return tuple(float(_CHECKS.number(name, one, (1e-6, 1e6))) for one in each)
