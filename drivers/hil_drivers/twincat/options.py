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
"""Least and most of the options that are numbers."""

_CHECKS = OptionChecks("twincat")

WHOLE = ("port", "block_rows", "chunk_bytes")
ADS_PORT = 48898
DEFAULT_PREFIX = "GVL_Hil"

_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass(frozen=True, slots=True)
class Options:
    """The options of one arm.

    Attributes:
        address: IP address or host name of the PLC, and a TCP port where it is not 48898.
        ams_net_id: Of the PLC; on this computer made of the address, as the mock's is.
        local_net_id: Of this computer, where the route on the PLC has another one than the
            library's default, the computer's address and `.1.1`.
        port: AMS port of the PLC's runtime.
        prefix: Variable list of the PLC that has the contract's variables.
        rate_hz: Cycles of the PLC's task per second.
        block_rows: Rows that a read waits for, since a request takes about a millisecond.
        chunk_bytes: Most that is read or written in one request.
        effort: What the drives measure: torque at the joint [N·m], or motor current [A].
        drive_gains_nm_a: Torque per current at the joint; the arm's own by default.
        late_s: Silence of the PLC that ends a motion [s].
        speed_share: Share of the arm's joint speeds that may be used.
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
        """The PLC, whatever a station calls it.

        A PLC keeps one TCP connection per computer, so two programs of one computer cannot drive
        two of its arms.
        """
        return f"ads://{self.ams_net_id}"

    @property
    def route(self) -> Address:
        """See `hil.robot.HasAddress`.

        A router on this computer may lead to a real PLC, which its AMS net id names.
        """
        here = is_loopback(self.host[0]) and self.ams_net_id.startswith("127.")
        return Address(f"{self.address} (AMS net id {self.ams_net_id})", real=not here)

    @property
    def host(self) -> tuple[str, int]:
        """Host and TCP port of the PLC's ADS."""
        host, _, port = self.address.partition(":")
        return host, int(port or ADS_PORT)


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """Return the options that a station file gives.

    Args:
        given: Option → value.
        model: Built-in arm.

    Raises:
        SpecError: An option is missing, unknown, or has a value that is not possible.
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
    """Return an address in the one form that addresses are compared in."""
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
