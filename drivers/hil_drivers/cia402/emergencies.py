"""What a drive's error codes mean: EMCY messages, 603Fh, 1003h and the error register 1001h.

Codes by CiA 301 and CiA 402; the more a pattern leaves open, the later it is asked.
"""

from __future__ import annotations

from hil_drivers.cia402.contracts import Emergency

TEXTS = {
    0x1000: "generic error",
    0x2110: "short circuit or earth fault at the input",
    0x2211: "over-current at the input",
    0x2220: "continuous over-current inside",
    0x2230: "short circuit or earth fault inside",
    0x2250: "short circuit inside",
    0x2310: "continuous over-current at the output",
    0x2320: "short circuit or earth fault at the output",
    0x2330: "earth fault at the output",
    0x2340: "short circuit at the output",
    0x2350: "I²t of the motor",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase lost",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3230: "load error",
    0x3310: "output over-voltage",
    0x4110: "surroundings too hot",
    0x4120: "surroundings too cold",
    0x4210: "device too hot",
    0x4220: "device too cold",
    0x4310: "drive or motor too hot",
    0x4320: "drive or motor too cold",
    0x4410: "supply too hot",
    0x5112: "24 V supply too low",
    0x5400: "power section",
    0x5441: "safe torque off, or the enable contact is open",
    0x5510: "memory",
    0x5530: "data in non-volatile memory",
    0x6010: "watchdog of the firmware",
    0x6310: "loss of parameters",
    0x6320: "wrong parameters",
    0x7110: "brake chopper",
    0x7121: "motor blocked",
    0x7122: "motor or its commutation",
    0x7180: "holding brake",
    0x7300: "sensor",
    0x7303: "resolver 1",
    0x7305: "encoder 1",
    0x7306: "encoder 2",
    0x7310: "overspeed",
    0x7320: "position sensor",
    0x7500: "communication with a part inside",
    0x8110: "CAN frames lost (overrun)",
    0x8120: "CAN controller error passive",
    0x8130: "heartbeat of the master lost",
    0x8140: "recovered from bus-off",
    0x8150: "two nodes with one COB-ID",
    0x8210: "PDO of the wrong length, not used",
    0x8220: "PDO too long",
    0x8240: "SYNC of the wrong length",
    0x8250: "time-out of an RPDO",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8321: "insufficient torque",
    0x8331: "torque fault",
    0x8400: "velocity controller",
    0x8480: "velocity control: error too large",
    0x8500: "position controller",
    0x8611: "following error",
    0x8612: "reference limit: set-point out of range",
    0x8700: "sync controller: SYNC or set-points came at the wrong time, or not at all",
    0x9000: "external error",
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control",
}
"""By code."""

RANGES = (
    (0xFFF0, 0x2310, "over-current at the output"),
    (0xFFF0, 0x3210, "DC link over-voltage"),
    (0xFFF0, 0x3220, "DC link under-voltage"),
    (0xFFF0, 0x8610, "positioning controller"),
    (0xFF00, 0x2100, "current at the input"),
    (0xFF00, 0x2200, "current inside the device"),
    (0xFF00, 0x2300, "current at the output"),
    (0xFF00, 0x3100, "mains voltage"),
    (0xFF00, 0x3200, "DC link voltage"),
    (0xFF00, 0x3300, "output voltage"),
    (0xFF00, 0x4200, "device temperature"),
    (0xFF00, 0x4300, "drive or motor temperature"),
    (0xFF00, 0x5100, "supply of the electronics"),
    (0xFF00, 0x5200, "control hardware"),
    (0xFF00, 0x6100, "firmware"),
    (0xFF00, 0x6200, "user program"),
    (0xFF00, 0x6300, "parameters"),
    (0xFF00, 0x7100, "power section or brake"),
    (0xFF00, 0x7300, "sensor"),
    (0xFF00, 0x8100, "communication"),
    (0xFF00, 0x8200, "protocol"),
    (0xFF00, 0x8300, "torque control"),
    (0xFF00, 0x8400, "velocity control"),
    (0xFF00, 0x8500, "position control"),
    (0xFF00, 0x8600, "positioning control"),
    (0xFF00, 0x8700, "synchronisation"),
    (0xFF00, 0xFF00, "vendor's own error"),
    (0xF000, 0x1000, "generic error"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "hardware of the device"),
    (0xF000, 0x6000, "software of the device"),
    (0xF000, 0x7000, "additional modules"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "external error"),
    (0xF000, 0xF000, "additional functions"),
)
"""Mask, what is left of a code under it, text."""

REGISTER = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "vendor's own",
)
"""Bits of 1001h, from bit 0."""


def error_text(code: int) -> str:
    """An error code in words, with its number as manuals write it."""
    return f"{_words(code)} ({code:04X}h)"


def register_text(register: int) -> str:
    """The bits of 1001h in words; empty when none is set."""
    return ", ".join(text for bit, text in enumerate(REGISTER) if register >> bit & 1)


def emergency_text(emergency: Emergency) -> str:
    """All that an EMCY message says but whose it is."""
    if emergency.code == 0:
        return "errors are gone (0000h)"
    register = register_text(emergency.register)
    vendors = emergency.data.hex(" ") if any(emergency.data) else ""
    beside = [
        f"error register: {register}" if register else "",
        f"data {vendors}" if vendors else "",
    ]
    told = ", ".join(text for text in beside if text)
    return f"{error_text(emergency.code)}; {told}" if told else error_text(emergency.code)


def _words(code: int) -> str:
    if code == 0:
        return "no error"
    if code in TEXTS:
        return TEXTS[code]
    return next((text for mask, kept, text in RANGES if code & mask == kept), "unknown error")
