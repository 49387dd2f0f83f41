"""MJCF as one document: what is included put in, what cannot move a body taken out.

MuJoCo's compiler is given it.  Files are data: those that a document names are read from relative
paths only, each up to a size, so many at most.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath

from undertow.base import ArtefactError, InvalidInputError, ModelError, one_of, read_file
from undertow.models.importers.tree import FREE_BASE, MOST_MOVING
from undertow.models.importers.xml_files import (
    LARGEST,
    MOST,
    is_text,
    numbers_of,
    parse_xml,
    source_words,
)

#: Most files that one model is made of, and most bytes of all its meshes.
MOST_FILES, MOST_MESHES = 200, 1 << 28

#: Sections that say nothing about motion, and elements of bodies that do not either.
_SECTIONS = {"contact", "custom", "keyframe", "sensor", "size", "statistic", "visual"}
_SHOWN = {"camera", "light"}
#: Attributes that hold words, and texts that mean no number although they look like one.
_NAMING = {"name", "class", "childclass", "file", "model"}
_ODD = re.compile(r"(?i)(?<![a-z_])[-+]?(nan|inf|infinity)(?![a-z_0-9])")

#: Options that say something about motion.
_OPTIONS = {"actuatorgroupdisable", "gravity", "density", "viscosity", "wind"}
_FLAGS = {"gravity", "spring", "damper", "passive", "actuation"}
_ORIENTED = ("quat", "axisangle", "euler", "xyaxes", "zaxis")


@dataclass(eq=False)
class Document:
    """An MJCF document of its own.

    ``files``: meshes by the names that the elements have for them; ``frozen``: names of the joints
    that were taken out; ``what``: which file it is, for messages.
    """

    root: ET.Element
    files: dict[str, bytes] = field(default_factory=dict)
    frozen: tuple[str, ...] = ()
    what: str = "MJCF"

    @property
    def text(self) -> str:
        """The document as it is given to MuJoCo's compiler."""
        return ET.tostring(self.root, encoding="unicode")


def mjcf_document(source: str | Path, frozen: Sequence[str] = ()) -> Document:
    """Read an MJCF file or text with all that it includes.

    Joints that are ``frozen`` are taken out: their bodies stay where they are drawn. Raises
    ArtefactError for a file that cannot be read; InvalidInputError for what is no XML or is too
    large, and for a frozen joint that does not exist; ModelError for what is no model, a model in
    which nothing moves or too much does, and free bodies.
    """
    folder = None if is_text(source) else Path(source).parent
    root = parse_xml(source, "mujoco")
    _Includes(folder, root).into(root, folder)
    count = sum(1 for _ in root.iter())
    if count > MOST:
        raise InvalidInputError(
            "<mujoco> file with what it includes",
            value=f"{count} elements",
            limit=f"at most {MOST}",
            remedy="Keep the bodies of one mechanism alone",
        )
    _check_numbers(root)
    _freeze(root, frozen)
    _check_moving(root)
    _to_local_frames(root)
    _main_class(root)
    document = Document(root, frozen=tuple(frozen), what=source_words(source, "mujoco"))
    _strip(root)
    _meshes(document, folder)
    return document


def _relative(named: str, folder: Path | None, what: str) -> PurePosixPath:
    """The path of a file that a document names, which has to be relative to the document."""
    path = PurePosixPath(named.replace("\\", "/"))
    if folder is None or not named or path.is_absolute() or PureWindowsPath(named).drive:
        raise InvalidInputError(
            f"{what} file of the MJCF",
            value=repr(named),
            limit="a path relative to the model's own file",
            remedy="Give the model as a file, not as text" if folder is None else
            "Copy it beside the model and name it from there",
        )  # fmt: skip
    return path


class _Includes:
    """Puts the children of included files in the place of ``<include>``."""

    def __init__(self, folder: Path | None, root: ET.Element) -> None:
        self.main, self.count = folder, 0

    def into(self, parent: ET.Element, folder: Path | None, depth: int = 0) -> None:
        for child in list(parent):
            if child.tag != "include":
                self.into(child, folder, depth)
                continue
            named = child.get("file", "")
            path = _relative(named, self.main, "included")
            assert self.main is not None
            assert folder is not None
            # MuJoCo looks beside the model first, then beside the file that includes.
            places = [place / path for place in dict.fromkeys((self.main, folder))]
            found = next((p for p in places if p.exists()), places[0])
            self.count += 1
            if self.count > MOST_FILES or depth > 16:
                raise InvalidInputError(
                    "files included by the MJCF",
                    value=f"{self.count}, {depth} deep",
                    limit=f"at most {MOST_FILES}, 16 deep",
                    remedy="Does one include itself?",
                )
            inner = parse_xml(found, "mujoco", "mujocoinclude")
            self.into(inner, found.parent, depth + 1)
            place = list(parent).index(child)
            parent.remove(child)
            for offset, element in enumerate(list(inner)):
                parent.insert(place + offset, element)


def _joints(root: ET.Element) -> list[ET.Element]:
    return [
        joint
        for world in root.iterfind("worldbody")
        for joint in world.iter()
        if joint.tag in ("joint", "freejoint")
    ]


def _check_numbers(root: ET.Element) -> None:
    """Refuse what a compiler would pass over: numbers that are none, and axes of nothing."""
    for element in root.iter():
        for attribute, text in element.attrib.items():
            if attribute not in _NAMING and _ODD.search(text):
                numbers_of(element, attribute)
        if element.tag == "joint" and not any(numbers_of(element, "axis", "0 0 1")):
            raise ModelError(
                f"axis of joint '{element.get('name', '')}'",
                value=element.get("axis"),
                limit="not zero",
                remedy="Give the direction of the hinge or slide",
            )


def _freeze(root: ET.Element, frozen: Sequence[str]) -> None:
    """Take joints out, with what drives them."""
    names = [name for joint in _joints(root) if (name := joint.get("name"))]
    for name in frozen:
        one_of("frozen joint", name, names, "Name joints as the file does")
    for tendon in root.iterfind("tendon/*"):
        for part in tendon.iterfind("joint"):
            if part.get("joint") in frozen:
                raise ModelError(
                    f"frozen joint '{part.get('joint')}'",
                    value=f"part of tendon '{tendon.get('name', '')}'",
                    limit="a joint that nothing else hangs on",
                    remedy="Take the tendon out of the file",
                )
    for parent in list(root.iter()):
        for child in list(parent):
            joint = child.get("name") if child.tag in ("joint", "freejoint") else None
            driven = child.get("joint") or child.get("jointinparent")
            moved = parent.tag == "actuator" and driven in frozen
            if moved or (joint in frozen and parent.tag not in ("default", "equality")):
                parent.remove(child)


def _check_moving(root: ET.Element) -> None:
    """Refuse models without joints or with too many, before meshes are read for them."""
    joints = _joints(root)
    name = root.get("model", "mujoco")
    for joint in joints:
        kind = "free" if joint.tag == "freejoint" else joint.get("type", "hinge")
        if kind in ("free", "ball"):
            raise free_body(joint.get("name") or "of " + name, kind)
    if len(joints) > MOST_MOVING:
        raise ModelError(
            f"moving joints of '{name}'",
            value=len(joints),
            limit=f"at most {MOST_MOVING}",
            remedy="Keep the bodies that the mechanism is about, or freeze joints by name: "
            "FILE.xml:-JOINT,-JOINT",
        )


def free_body(joint: str, kind: str) -> ModelError:
    """The refusal of a joint that has no single coordinate."""
    return ModelError(
        f"joint {joint}",
        value=f"a joint of type {kind!r}",
        limit="hinge and slide joints",
        remedy=FREE_BASE,
    )


def _to_local_frames(root: ET.Element) -> None:
    """Undo ``coordinate="global"``, which MuJoCo reads no more.

    All is given in the frame of the world there, and any frame will do for a body: the world's.
    """
    compilers = root.findall("compiler")
    if not any(c.get("coordinate") == "global" for c in compilers):
        return
    for body in root.iter("body"):
        for joint in body.iterfind("joint"):
            if body.get("pos") and not joint.get("pos"):
                joint.set("pos", body.get("pos", ""))
        for given in ("pos", *_ORIENTED):
            body.attrib.pop(given, None)
    for compiler in compilers:
        compiler.attrib.pop("coordinate", None)


def _main_class(root: ET.Element) -> None:
    """Call the outermost default class ``main``, as MuJoCo has it since version 4."""
    outermost = root.findall("default")
    own = outermost[0].get("class", "main") if len(outermost) == 1 else "main"
    if own == "main" or any(inner.get("class") == "main" for inner in outermost[0].iter("default")):
        return
    for element in root.iter():
        for attribute in ("class", "childclass"):
            if element.get(attribute) == own:
                element.set(attribute, "main")


def _strip(root: ET.Element) -> None:
    """Take out what is only seen, sensed or touched, and how an engine would integrate."""
    for option in root.iterfind("option"):
        option.attrib = {k: v for k, v in option.attrib.items() if k in _OPTIONS}
        for flag in option.iterfind("flag"):
            flag.attrib = {k: v for k, v in flag.attrib.items() if k in _FLAGS}
    for inertial in root.iter("inertial"):
        inertial.attrib.setdefault("pos", "0 0 0")
    for element in list(root.iter()):
        element.attrib.pop("material", None)
        for child in list(element):
            seen = child.tag in _SHOWN or (element is root and child.tag in _SECTIONS)
            ground = element.tag == "worldbody" and child.tag == "geom"
            if seen or ground or (child.tag == "geom" and child.get("type") == "hfield"):
                element.remove(child)
    for asset in root.iterfind("asset"):
        for child in list(asset):
            if child.tag not in ("mesh", "model"):
                asset.remove(child)
    infer = [c.get("inertiafromgeom") for c in root.iterfind("compiler")]
    if "true" not in infer:
        for body in root.iter("body"):
            if body.find("inertial") is not None:
                for geom in body.findall("geom"):
                    body.remove(geom)


def _meshes(document: Document, folder: Path | None) -> None:
    """Read the meshes that inertias come from; those that nothing needs are taken out."""
    root = document.root
    needed = {geom.get("mesh") for geom in root.iter("geom")}
    directory = PurePosixPath("")
    for compiler in root.iterfind("compiler"):
        directory = PurePosixPath(compiler.get("meshdir", compiler.get("assetdir", directory)))
        for attribute in ("meshdir", "assetdir", "texturedir"):
            compiler.attrib.pop(attribute, None)
    size = 0
    for asset in root.iterfind("asset"):
        for model in asset.findall("model"):
            raise ModelError(
                document.what,
                value=f"<model file='{model.get('file', '')}'>, of which parts are attached",
                limit="one document, with what it includes",
                remedy="Let MuJoCo write it as one: spec = mujoco.MjSpec.from_file(FILE); "
                "spec.compile(); spec.to_xml()",
            )
        for mesh in asset.findall("mesh"):
            named = mesh.get("file", "")
            name = mesh.get("name") or PurePosixPath(named).stem
            if name not in needed:
                asset.remove(mesh)
                continue
            if not named:
                continue  # its points are in the document
            path = _relative(str(directory / named), folder, "mesh")
            assert folder is not None
            try:
                content = read_file(folder / path, "mesh", most=LARGEST)
            except ArtefactError as error:
                raise ModelError(
                    f"inertia of the body of mesh '{name}'",
                    value=f"no mesh: {error.value}",
                    limit=f"an <inertial>, or the file {path} beside the model",
                    remedy="Bring the mesh, or write the body's <inertial>",
                ) from error
            size += len(content)
            if len(document.files) >= MOST_FILES or size > MOST_MESHES:
                raise InvalidInputError(
                    "meshes of the MJCF",
                    value=f"{len(document.files) + 1} files, {size} bytes",
                    limit=f"at most {MOST_FILES}, {MOST_MESHES} bytes",
                    remedy="Write the bodies' <inertial>",
                )
            key = f"mesh_{len(document.files)}{path.suffix}"
            mesh.set("name", name)
            mesh.set("file", key)
            document.files[key] = content
