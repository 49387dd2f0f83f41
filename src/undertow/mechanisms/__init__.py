"""The library of mechanisms: one file each, parameters as data, sources cited."""

from undertow.mechanisms.rotary_pendulum import rotary_pendulum

__all__ = ["rotary_pendulum"]
