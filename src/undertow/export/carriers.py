"""What carries the exported C elsewhere: FMI, ROS 2, Simulink.

Each is the same C with a few lines around it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.sax.saxutils import escape

from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, one_of
from undertow.export.controller import EmbeddedController
from undertow.export.fmi import fmi_units
from undertow.export.names import ascii_words, at_most, c_name
from undertow.export.sources import common, controller_files, render


def carriers(
    controller: EmbeddedController,
    platforms: Iterable[str],
    compiler: str = "gcc",
    start: ArrayLike | None = None,
) -> dict[str, bytes]:
    """Return what carries a controller's C to other tools: file names to contents.

    Parameters
    ----------
    controller
        What is exported.
    platforms
        Some of ``"fmi"``, the two co-simulation units of :func:`fmi_units`; ``"ros2"``, a package
        with a ros2_control controller, in a folder of its own; ``"simulink"``, a Level-2
        S-function, which is compiled with the controller's C.
    compiler
        What builds the co-simulation units; it takes GCC's options.
    start
        Where the plant's unit starts unless told otherwise, (2n,), rad or m and their rates;
        ``None``: the mechanism's usual start.

    Raises
    ------
    InvalidInputError
        For another word, and where a name or the period cannot be had there.
    MissingExtraError
        When there is no such compiler.
    """
    makers = {
        "fmi": lambda: fmi_units(controller, compiler, start),
        "ros2": lambda: ros2_package(controller),
        "simulink": lambda: s_function(controller),
    }
    made: dict[str, bytes] = {}
    for platform in dict.fromkeys(platforms):
        one_of("platform to export for", platform, makers)
        made |= makers[platform]()
    return made


def s_function(controller: EmbeddedController) -> dict[str, bytes]:
    """Return ``<name>_sfun.c``, to be compiled by ``mex`` together with ``<name>.c``."""
    values = common(controller)
    return {f"{controller.stem}_sfun.c": render("simulink.c", values, controller.prefix)}


def ros2_package(controller: EmbeddedController) -> dict[str, bytes]:
    """Return a ROS 2 package with the controller, in the folder ``undertow_<name>``.

    Raises InvalidInputError when the period is not that of a whole number of updates in a second.
    """
    mechanism = controller.mechanism
    rate = 1 / controller.period
    if abs(rate - round(rate)) > 1e-6 * rate:
        raise InvalidInputError(
            "period of a ros2_control controller",
            value=f"{controller.period:g} s",
            limit="1/k s, k whole: update rates are whole numbers, Hz",
            remedy=f"Use for instance --period {1 / max(1, round(rate)):.8g}",
        )
    package = "undertow_" + re.sub(r"_+", "_", controller.stem.lower()).strip("_")
    values = common(controller) | {
        "package": package,
        "rate": str(round(rate)),
        "m": str(mechanism.m),
        # Quoted: in YAML y and n are truths.
        "joints": ", ".join(f'"{c_name(c.name)}"' for c in mechanism.coordinates),
        "units": ", ".join(c.unit for c in mechanism.coordinates),
        "inputs": ", ".join(ascii_words(f"{u.name} ({at_most(u)})") for u in mechanism.inputs),
    }
    places = {
        "package.xml": "ros2_package.xml",
        "CMakeLists.txt": "ros2_CMakeLists.txt",
        "plugin.xml": "ros2_plugin.xml",
        "config/controller.yaml": "ros2_controller.yaml",
        "src/controller.hpp": "ros2_controller.hpp",
        "src/controller.cpp": "ros2_controller.cpp",
    }
    in_xml = values | {"title": escape(values["title"])}
    made = {
        f"{package}/{place}": render(
            source, in_xml if place.endswith(".xml") else values, controller.prefix
        )
        for place, source in places.items()
    }
    for name, content in controller_files(controller).items():
        made[f"{package}/src/{name}"] = content
    return made
