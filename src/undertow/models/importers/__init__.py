"""Importers: mechanisms from equations, energies, SymPy's mechanics, URDF and MJCF files.

Each returns a :class:`~undertow.models.Mechanism`: actuated coordinates first, the target at
x = 0, physical parameters as data.
"""

from undertow.models.importers.coordinates import ActuatedForm, actuate
from undertow.models.importers.drives import DCMotor, voltage_driven
from undertow.models.importers.equations import from_energies, from_matrices
from undertow.models.importers.equilibrium import (
    at_equilibrium,
    find_equilibrium,
    holding_input,
    least_peak,
    move_target,
)
from undertow.models.importers.mjcf import from_mjcf, read_mjcf
from undertow.models.importers.python_file import mechanism_from_file
from undertow.models.importers.rigid_body import mechanism_from_tree
from undertow.models.importers.sympy_mechanics import from_kane, from_lagrange
from undertow.models.importers.tree import Actuator, Coupling, Joint, Link, Tree
from undertow.models.importers.urdf import from_urdf, read_urdf

__all__ = [
    "ActuatedForm",
    "Actuator",
    "Coupling",
    "DCMotor",
    "Joint",
    "Link",
    "Tree",
    "actuate",
    "at_equilibrium",
    "find_equilibrium",
    "from_energies",
    "from_kane",
    "from_lagrange",
    "from_matrices",
    "from_mjcf",
    "from_urdf",
    "holding_input",
    "least_peak",
    "mechanism_from_file",
    "mechanism_from_tree",
    "move_target",
    "read_mjcf",
    "read_urdf",
    "voltage_driven",
]
