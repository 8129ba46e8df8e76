"""Published facts about built-in arms: neutral data that identification and mock may both read.

Kinematics, limits, nominal masses and collision capsules come from the makers and carry their
source in the YAML beside this file. Nothing here says what a *particular* robot is like: truth
lives in the mock, estimates live in models.
"""

from hil.arms.description import (
    ArmDescription,
    Capsule,
    arm_from_dict,
    arm_names,
    is_described,
    is_description,
    load_arm,
)
from hil.arms.own_file import model_sha256, require_same_arm
from hil.arms.payload import Payload

__all__ = [
    "ArmDescription",
    "Capsule",
    "Payload",
    "arm_from_dict",
    "arm_names",
    "is_described",
    "is_description",
    "load_arm",
    "model_sha256",
    "require_same_arm",
]
