"""Rigs, plants to meet: the ideal model, a realistic bench, MuJoCo, hardware of one's own."""

from undertow.rig.bench import Amplifier, Backlash, Bench, Encoder, Friction, Push, Timing
from undertow.rig.interface import Measurement, OutputOnError, Rig
from undertow.rig.mujoco_rig import MuJoCoRig
from undertow.rig.paced import Paced
from undertow.rig.presets import plausible_rig, srv02_rig
from undertow.rig.python_file import check_rig, rig_from_file
from undertow.rig.simulated import IdealRig, RealisticRig

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
