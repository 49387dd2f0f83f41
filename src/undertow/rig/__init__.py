"""Rigs, plants to meet: the ideal model, a realistic bench, MuJoCo, hardware of one's own."""

from undertow.rig.interface import Measurement, Rig

__all__ = ["Measurement", "Rig"]
