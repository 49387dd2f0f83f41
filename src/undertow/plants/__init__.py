"""Rigs, plants to meet: the ideal model, a realistic bench, MuJoCo, hardware of one's own."""

from undertow.plants.bench import (
    Amplifier,
    Backlash,
    Bench,
    Encoder,
    Friction,
    Push,
    Timing,
    plausible_rig,
    srv02_rig,
)
from undertow.plants.interface import (
    Measurement,
    OutputOnError,
    Paced,
    Rig,
    RigWrapper,
    check_rig,
    control_loop,
    rig_from_file,
)
from undertow.plants.mujoco_rig import MuJoCoRig
from undertow.plants.simulated import IdealRig, RealisticRig

__all__ = [
    "Amplifier",
    "Backlash",
    "Bench",
    "Encoder",
    "Friction",
    "IdealRig",
    "Measurement",
    "MuJoCoRig",
    "OutputOnError",
    "Paced",
    "Push",
    "RealisticRig",
    "Rig",
    "RigWrapper",
    "Timing",
    "check_rig",
    "control_loop",
    "plausible_rig",
    "rig_from_file",
    "srv02_rig",
]
