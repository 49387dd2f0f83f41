"""Rigs, plants to meet: the ideal model, a realistic bench, MuJoCo, hardware of one's own."""

from undertow.plants.bench import Amplifier, Backlash, Bench, Encoder, Friction, Push, Timing
from undertow.plants.interface import Measurement, OutputOnError, Rig
from undertow.plants.mujoco_rig import MuJoCoRig
from undertow.plants.paced import Paced
from undertow.plants.presets import plausible_rig, srv02_rig
from undertow.plants.python_file import check_rig, rig_from_file
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
    "Timing",
    "check_rig",
    "plausible_rig",
    "rig_from_file",
    "srv02_rig",
]
