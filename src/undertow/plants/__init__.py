"""Rigs, simulated or real: what a controller reads, writes and closes.

:mod:`.interface` says what a rig is; hardware of one's own implements it. :mod:`.simulated` has
the ideal model and the realistic bench, whose imperfections are the data of :mod:`.bench`;
:mod:`.mujoco_rig` moves the scenes of :mod:`.scenes` in MuJoCo.
"""

from undertow.plants.bench import (
    Amplifier,
    Backlash,
    Bench,
    Encoder,
    Friction,
    Push,
    Timing,
    full_forces,
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
    "full_forces",
    "plausible_rig",
    "rig_from_file",
    "srv02_rig",
]
