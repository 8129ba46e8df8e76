"""Load an arm's published description from `hil/arms/<name>.yaml`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms.content import description_sha256
from hil.core import FloatArray, SpecError


@dataclass(frozen=True, slots=True)
class Capsule:
    """A collision body: all points within `radius` of the segment from `a` to `b`.

    Attributes:
        link: 0 for the fixed base, 1…n for the links in their DH frames.
        a, b: Ends of the axis in the link's frame [m].
        radius: [m].
    """

    link: int
    a: tuple[float, float, float]
    b: tuple[float, float, float]
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmDescription:
    """An arm as its maker publishes it, in SI units and standard (distal) DH convention.

    `load_arm` gives everybody the same one, so its arrays cannot be written.

    Attributes:
        name: Key of the arm, e.g. `ur5`, or the path of its description.
        joint_names: Length n.
        dh: (n, 4) rows of a [m], alpha [rad], d [m], theta offset [rad].
        q_min, q_max: Position limits [rad], (n,).
        qd_max, qdd_max: Velocity [rad/s] and acceleration [rad/s²] limits, (n,).
        effort_max: Joint torque limits [N·m], (n,).
        excite_min, excite_max: The range excitation uses unless a spec says otherwise [rad], (n,).
        mass: (n,) nominal link masses [kg].
        com: (n, 3) nominal centres of mass in the link's DH frame [m].
        inertia: (n, 3, 3) nominal inertia about the centre of mass, DH axes [kg·m²].
        gear_ratio: (n,) motor revolutions per joint revolution.
        drive_gains: (n,) torque per motor current at the joint [N·m/A].
        rate_hz: State and command rate of the controller [Hz].
        payload_max_kg: Rated payload [kg].
        capsules: Collision bodies, base and links.
        sources: Where each number comes from, by topic.
        link_names: (n + 1,) what people call the base and the links, for messages.
        joints_per_motor: (n, n) joint angles per angle of the motors behind their gears; not the
            unit matrix where a motor also moves a neighbour of its joint.
        guessed: What of it nobody knows: such numbers are good enough for a mock alone.
        sha256: Of what an arm of one's own is described as (`hil.arms.content`); empty for a
            built-in arm.
        file_sha256: Of the bytes of that file.
    """

    name: str
    joint_names: tuple[str, ...]
    dh: FloatArray
    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray
    effort_max: FloatArray
    excite_min: FloatArray
    excite_max: FloatArray
    mass: FloatArray
    com: FloatArray
    inertia: FloatArray
    gear_ratio: FloatArray
    drive_gains: FloatArray
    rate_hz: float
    payload_max_kg: float
    capsules: tuple[Capsule, ...]
    sources: Mapping[str, str]
    link_names: tuple[str, ...]
    joints_per_motor: FloatArray
    guessed: tuple[str, ...] = ()
    sha256: str = ""
    file_sha256: str = ""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)


def arm_names() -> tuple[str, ...]:
    """Names of the built-in arms."""
    folder = files("hil.arms")
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".yaml")))


def is_description(model: str) -> bool:
    """Whether a robot's `model` is the path of a description, in place of a built-in arm's name."""
    return model.casefold().endswith((".yaml", ".yml"))


def is_described(model: str) -> bool:
    """Whether an arm is built in, or described in a file of one's own: with collision bodies."""
    return model in arm_names() or is_description(model)


def load_arm(name: str) -> ArmDescription:
    """The built-in arm called `name`, or the one that a file describes; parsed once per process.

    Raises:
        SpecError: There is no such arm, or its description cannot be used.
    """
    return _parsed(name)


@cache
def _parsed(name: str) -> ArmDescription:
    from hil.core import look_into  # a model file is read without PyYAML

    if is_description(name):
        arm = _of_file(Path(name))
    elif name in arm_names():
        text = files("hil.arms").joinpath(f"{name}.yaml").read_text("utf-8")
        arm = arm_from_dict(name, look_into(text))
    else:
        raise SpecError(
            f"there is no built-in arm {name!r}",
            hint=f"built in are {', '.join(arm_names())}; a path to a URDF works too",
        )
    for value in (getattr(arm, field.name) for field in fields(arm)):
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return arm


def _of_file(path: Path) -> ArmDescription:
    """An arm that a file describes as those beside this module are."""
    from hil.core import look_into

    hint = "`hil new own-urdf` writes one from a URDF; hil/arms/ur5.yaml is one, too"
    try:
        raw = path.read_bytes()
        document = look_into(raw.decode("utf-8"))
    except (OSError, ValueError) as error:
        raise SpecError(f"{path}: cannot be read as an arm: {error}", hint=hint) from None
    try:
        arm, digest = arm_from_dict(str(path), document), description_sha256(document)
        return replace(arm, sha256=digest, file_sha256=sha256(raw).hexdigest())
    except KeyError as error:
        raise SpecError(f"{path}: the arm lacks {error.args[0]!r}", hint=hint) from None
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SpecError(f"{path}: describes no arm: {error}", hint=hint) from None


def arm_from_dict(name: str, raw: dict[str, Any]) -> ArmDescription:
    """An arm from the content of its file.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: It describes none.
    """
    joints, links = raw["joints"], raw["links"]

    def column(key: str, scale: float = 1.0) -> FloatArray:
        return np.array([joint[key] for joint in joints], dtype=np.float64) * scale

    if (column("drive_gain_nm_a") == 0).any():
        raise ValueError("a drive_gain_nm_a is 0; write null where it is not known")
    degree = np.pi / 180
    dh = np.array([[j["a_m"], j["alpha_deg"], j["d_m"], j["theta_deg"]] for j in joints])
    dh[:, [1, 3]] *= degree
    return ArmDescription(
        name=name,
        joint_names=tuple(joint["name"] for joint in joints),
        dh=dh,
        q_min=column("q_min_deg", degree),
        q_max=column("q_max_deg", degree),
        qd_max=column("qd_max_deg_s", degree),
        qdd_max=column("qdd_max_deg_s2", degree),
        effort_max=column("effort_max_nm"),
        excite_min=column("excite_min_deg", degree),
        excite_max=column("excite_max_deg", degree),
        mass=np.array([link["mass_kg"] for link in links]),
        com=np.array([link["com_m"] for link in links]),
        inertia=np.array([_symmetric(link["inertia_kgm2"]) for link in links]),
        gear_ratio=column("gear_ratio"),
        drive_gains=column("drive_gain_nm_a"),
        rate_hz=float(raw["rate_hz"]),
        payload_max_kg=float(raw["payload_max_kg"]),
        capsules=tuple(
            Capsule(c["link"], tuple(c["a_m"]), tuple(c["b_m"]), c["radius_m"])
            for c in raw["capsules"]
        ),
        sources=raw["sources"],
        link_names=("base", *(link.get("name", f"link {i}") for i, link in enumerate(links, 1))),
        joints_per_motor=np.array(raw.get("joints_per_motor", np.eye(len(joints))), np.float64),
        guessed=_words(raw.get("guessed", [])),
    )


def _words(raw: Any) -> tuple[str, ...]:
    if not isinstance(raw, list) or not all(isinstance(word, str) for word in raw):
        raise TypeError("`guessed` is a list of words, such as [qdd_max, capsules]")
    return tuple(raw)


def _symmetric(values: list[float]) -> FloatArray:
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=np.float64)
