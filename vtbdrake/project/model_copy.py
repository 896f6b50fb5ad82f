"""The copy of a model file for a project: with the files that it needs, in formats and spellings that Drake reads."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vtbdrake.project.meshes import CONVERTED, MeshError, can_convert, convert
from vtbdrake.project.model_faults import as_number, elements_read, faults, values
from vtbdrake.project.xml_text import XmlElement, XmlText

_MODEL_SUFFIXES = "urdf|sdf|xml|obj|mtl|stl|dae|ply|gltf|glb|bin|vtk|png|jpe?g|ktx2|tga|bmp"
_QUOTED_FILE = re.compile(rf"""["'>]\s*([^"'<>]+?\.(?:{_MODEL_SUFFIXES}))\s*["'<]""", re.IGNORECASE)
_OBJ_FILE = re.compile(rf"^\s*(?:mtllib|map_\w+|bump|disp|norm)\b.*?(\S+\.(?:{_MODEL_SUFFIXES}))\s*$", re.M | re.I)
_PACKAGE_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")
_URI = re.compile(r"(?:package|model):///?([^/\"'<>\s]+)/([^\"'<>]*)")
# Packages that Drake finds itself.
_OF_DRAKE = {"drake", "drake_models"}

URDF = "robot"
SDF = "sdf"
MJCF = "mujoco"
# The types of the joints of URDF with one degree of freedom.
_MOVING = ("revolute", "continuous", "prismatic")

_AXES = ("ixx", "iyy", "izz")
_PRODUCTS = ("ixy", "ixz", "iyz")
# The density of the sphere whose inertia a link without moments of inertia gets, in kg/m^3.
_DENSITY = 1000.0
# What a body without mass gets, in kg and kg m^2.
_NO_MASS = 1e-9
_NO_INERTIA = 1e-12
# A number, as Drake reads it.
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
# How many faults an error names.
_SHOWN = 3


@dataclass
class ModelCopy:
    """A model file and what it needs, as they will be in a folder.

    Attributes:
        model: The path of the model file in the folder.
        files: Path in the folder -> the file that is copied there, or its content.
        packages: The folders of the packages that the files name, in the folder.
        original_folder: The folder that the folder of the copy stands for.
        xml: The text of the model file as it is in the copy; None if it is no XML.
        included: The texts of the model files that it includes.
        missing: The packages that were not found, each with the sentence that says what to do.
        assumptions: What the file does not give, each with the values that are assumed instead.
        notes: What was changed, each with file and line.
        fault: What is wrong in the files and cannot be mended, with file, line and remedy; empty if nothing is.
    """

    model: Path
    files: dict[Path, Path | bytes]
    packages: dict[str, Path] = field(default_factory=dict)
    original_folder: Path = Path()
    xml: XmlText | None = None
    included: tuple[XmlText, ...] = ()
    missing: dict[str, str] = field(default_factory=dict)
    assumptions: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    fault: str = ""

    def write(self, folder: Path) -> Path:
        """Write the files into a folder, and return the path of the model file there."""
        for relative, content in self.files.items():
            file = folder / relative
            file.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                file.write_bytes(content.read_bytes())
            else:
                file.write_bytes(content)
        return folder / self.model


def copy_model(path: Path, shown: str, packages: Mapping[str, Path]) -> ModelCopy:
    """Return the copy of a model file in which what Drake refuses, and other programs take, is mended.

    Args:
        path: The model file.
        shown: How notes name it.
        packages: The folders of packages by name, which are not searched for.
    """
    return _Copier(path, shown, packages).copy()


class _Copier:
    def __init__(self, path: Path, shown: str, packages: Mapping[str, Path]) -> None:
        self._path, self._shown = path, shown
        self._roots, self._missing = find_packages(path, path.read_text("utf-8", "replace"), packages)
        self._sources = closure(path, self._roots)
        self._texts = {source: xml for source in self._sources if (xml := _parsed(source)) is not None}
        self._added: dict[Path, bytes] = {}  # what is made: path beside the source -> content
        self._notes: list[str] = []
        self._assumed: list[tuple[str, str, str]] = []  # place, link, moment of inertia

    def copy(self) -> ModelCopy:
        for source, xml in self._texts.items():
            self._separate_numbers(source, xml)
        every = [(source, *fault) for source, xml in self._texts.items() for fault in faults(xml.root)]
        fault = "; ".join(f"{self._place(source, element)}: {text}" for source, element, text in every[:_SHOWN])
        for source, xml in self._texts.items():
            self._mend(source, xml)
        self._convert_meshes()
        contents: dict[Path, Path | bytes] = {source: source for source in self._sources}
        contents |= {source: xml.encode() for source, xml in self._texts.items() if xml.changed}
        contents |= self._added
        in_packages = {name: [p for p in contents if p.is_relative_to(root)] for name, root in self._roots.items()}
        homeless = [path for path in contents if not any(path in paths for paths in in_packages.values())]
        top = _common_folder(homeless)
        files = {path.relative_to(top): contents[path] for path in homeless}
        folders = {}
        for name, root in self._roots.items():
            folders[name] = Path(root.name)
            paths = in_packages[name]
            files |= {folders[name] / path.relative_to(root): contents[path] for path in paths}
            if (root / "package.xml").is_file():
                files[folders[name] / "package.xml"] = root / "package.xml"
        model = next(relative for relative, content in files.items() if content is contents[self._path])
        return ModelCopy(
            model,
            files,
            folders,
            original_folder=top,
            xml=self._texts.get(self._path),
            included=tuple(xml for source, xml in self._texts.items() if source != self._path),
            missing=self._missing,
            assumptions=self._assumptions(),
            notes=self._notes,
            fault=fault,
        )

    def _assumptions(self) -> list[str]:
        if not self._assumed:
            return []
        values = ", ".join(f"{link} {moment}" for _, link, moment in self._assumed)
        return [
            f"{self._assumed[0][0]} gives a mass without moments of inertia, assumed is a solid sphere of "
            f"{_DENSITY:g} kg/m^3, in kg m^2: {values}"
        ]

    def _place(self, source: Path, element: XmlElement) -> str:
        shown = self._shown if source == self._path else min(str(source), os.path.relpath(source), key=len)
        return f"{shown}:{element.line}"

    # -- what Drake refuses

    def _mend(self, source: Path, xml: XmlText) -> None:
        kind = xml.root.tag
        if source == self._path:
            self._name_model(xml)
        if kind == URDF:
            self._forget_ranges(source, xml)
            self._rename_materials(source, xml)
            self._leave_mimics_out(source, xml)
            self._leave_transmissions_out(source, xml)
            self._shorten_uris(source, xml)
        if kind in (URDF, SDF):
            self._assume_inertia(source, xml)
        else:
            self._give_mass(source, xml)

    def _separate_numbers(self, source: Path, xml: XmlText) -> None:
        """Put blanks for commas between numbers, which Drake takes for no numbers."""
        separated = []
        for element in elements_read(xml.root):
            changed = {name: new for name, text in values(element).items() if (new := _with_blanks(text)) != text}
            if not changed:
                continue
            separated.append(element)
            if changed.keys() & element.attributes.keys():
                xml.set(element, **{name: text for name, text in changed.items() if name in element.attributes})
            else:
                xml.set_text(element, changed[element.tag])
        if separated:
            more = f", and so in {len(separated) - 1} more elements" if len(separated) > 1 else ""
            self._note(source, separated[0], f"commas between numbers count as blanks{more}")

    def _name_model(self, xml: XmlText) -> None:
        attribute = {URDF: "name", MJCF: "model"}.get(xml.root.tag)
        if attribute and not xml.root.get(attribute):
            xml.set(xml.root, **{attribute: re.sub(r"\W", "_", self._path.stem)})

    def _forget_ranges(self, source: Path, xml: XmlText) -> None:
        """Take out ranges of joints that turn without end, and from 0 to 0: exporters write it where they know none."""
        for joint in xml.root.iter("joint"):
            limit = joint.find("limit")
            if limit is None or not {"lower", "upper"} & limit.attributes.keys():
                continue
            is_unknown = all(_is_zero(limit.get(end, "0")) for end in ("lower", "upper"))
            if joint.get("type") == "continuous" or (joint.get("type") in _MOVING and is_unknown):
                xml.set(limit, lower=None, upper=None)
                if joint.get("type") != "continuous":
                    self._note(source, joint, f"the range of {joint.get('name')} is 0 to 0, and counts as unknown")

    def _rename_materials(self, source: Path, xml: XmlText) -> None:
        """Give materials of one name and several colors names of their own; leave out those without a color."""
        defined: dict[str, dict[str, str]] = {}
        noted: set[str] = set()
        # Drake reads those outside of the links first.
        for material in sorted(xml.root.iter("material"), key=lambda material: material.parent is not xml.root):
            name, looks = material.get("name"), [material.find("color"), material.find("texture")]
            value = {key: text for look in looks if look for key, text in look.attributes.items()}
            if not value:
                if name not in defined and material.parent is not None and material.parent.tag == "visual":
                    xml.remove(material)
                    if name not in noted:
                        self._note(source, material, f"the material {name} is not defined: left out")
                    noted.add(name)
            elif name and defined.setdefault(name, value) != value:
                number = 2
                while defined.setdefault(f"{name}_{number}", value) != value:
                    number += 1
                xml.set(material, name=f"{name}_{number}")
                if name not in noted:
                    self._note(source, material, f"the material {name} is defined again, with another color: renamed")
                noted.add(name)

    def _leave_mimics_out(self, source: Path, xml: XmlText) -> None:
        """Take out the <mimic> of joints that do not move, or follow one that does not."""
        joints = {joint.get("name"): joint for joint in xml.root.children if joint.tag == "joint"}
        moving = {name for name, joint in joints.items() if joint.get("type") in _MOVING}
        for name, joint in joints.items():
            mimic = joint.find("mimic")
            if mimic is not None and not (name in moving and mimic.get("joint") in moving):
                xml.remove(mimic)
                why = "does not move" if name not in moving else f"follows {mimic.get('joint')}, which does not move"
                self._note(source, mimic, f"{name} {why}: its <mimic> is left out")

    def _leave_transmissions_out(self, source: Path, xml: XmlText) -> None:
        """Take out transmissions of joints that are not in the file."""
        joints = {joint.get("name") for joint in xml.root.children if joint.tag == "joint"}
        for transmission in [child for child in xml.root.children if child.tag == "transmission"]:
            named = [joint.get("name") for joint in transmission.children if joint.tag == "joint"]
            if absent := [name for name in named if name not in joints]:
                xml.remove(transmission)
                self._note(source, transmission, f"there is no joint {absent[0]}: its <transmission> is left out")

    def _shorten_uris(self, source: Path, xml: XmlText) -> None:
        for mesh in xml.root.iter("mesh"):
            if mesh.get("filename").startswith("package:///"):
                xml.set(mesh, filename=mesh.get("filename").replace(":///", "://", 1))

    def _assume_inertia(self, source: Path, xml: XmlText) -> None:
        """Give links that have a mass, but no moments of inertia, the moments of a solid sphere."""
        for link in xml.root.iter("link"):
            inertial = link.find("inertial")
            mass = inertial.find("mass") if inertial is not None else None
            inertia = inertial.find("inertia") if inertial is not None else None
            if mass is None or inertia is None:
                continue
            m = as_number(mass.get("value") or mass.text)
            moments = [inertia.find(axis) for axis in _AXES]
            values = [e.text if (e := moments[k]) is not None else inertia.get(_AXES[k]) for k in range(3)]
            if m > 0.0 and all(as_number(value) == 0.0 for value in values):
                radius = (3.0 * m / (4.0 * math.pi * _DENSITY)) ** (1.0 / 3.0)
                moment = f"{0.4 * m * radius**2:.3g}"
                if xml.root.tag == URDF:
                    xml.set(inertia, **dict.fromkeys(_AXES, moment), **dict.fromkeys(_PRODUCTS, "0"))
                else:
                    for element in filter(None, moments):
                        xml.set_text(element, moment)
                self._assumed.append((self._place(source, inertia), link.get("name"), moment))

    def _give_mass(self, source: Path, xml: XmlText) -> None:
        """Give bodies of MJCF without mass, which Drake ends the process for, next to none."""
        for inertial in xml.root.iter("inertial"):
            if _is_zero(inertial.get("mass")):
                xml.set(
                    inertial, mass=f"{_NO_MASS:g}", diaginertia=" ".join([f"{_NO_INERTIA:g}"] * 3), fullinertia=None
                )

    def _note(self, source: Path, element: XmlElement, text: str) -> None:
        self._notes.append(f"{self._place(source, element)}: {text}")

    # -- meshes

    def _convert_meshes(self) -> None:
        # The reasons for which meshes are left out, with their places.
        left_out: dict[str, list[str]] = {}
        converted: set[Path] = set()
        for source, xml in self._texts.items():
            for mesh in list(xml.root.iter("mesh")):
                reference = _reference(mesh)
                target = self._find(source, reference) if reference.lower().endswith(CONVERTED) else None
                if target is None:
                    continue
                converted.add(target)
                is_shape = mesh.parent is not None and mesh.parent.parent is not None and xml.root.tag != MJCF
                is_hull = is_shape and mesh.parent.parent.tag == "collision"  # type: ignore[union-attr]
                try:
                    name = self._converted(target, hull=is_hull)
                except MeshError as error:
                    left_out.setdefault(str(error), []).append(self._place(source, mesh))
                    self._leave_out(xml, mesh)
                else:
                    _refer(xml, mesh, reference[: len(reference) - len(target.name)] + name)
        self._sources = [source for source in self._sources if source not in converted]
        if converted and not left_out:
            return
        for why, places in left_out.items():
            more = f" and {len(places) - 1} more" if len(places) > 1 else ""
            self._notes.append(f"{places[0]}{more}: left out: {why}")

    def _converted(self, mesh: Path, *, hull: bool) -> str:
        """Convert a mesh, unless that is done, and return the name of the new file beside it."""
        if not can_convert(mesh):
            raise MeshError(
                f"meshes in {mesh.suffix.upper()[1:]} are converted by trimesh: pip install 'vtbdrake[meshes]'"
            )
        stem = f"{mesh.name}.hull" if hull else mesh.name
        if mesh.with_name(f"{stem}.obj") not in self._added:
            try:
                files = convert(mesh, stem, hull=hull)
            except MeshError as error:
                if not hull or "hull" not in str(error):
                    raise
                return self._converted(mesh, hull=False)
            self._added |= {mesh.with_name(name): content for name, content in files.items()}
        return f"{stem}.obj"

    def _leave_out(self, xml: XmlText, mesh: XmlElement) -> None:
        """Take out the <visual> or <collision> of a mesh; in MJCF, the mesh and the geoms that show it."""
        if xml.root.tag in (URDF, SDF):
            if mesh.parent is not None and mesh.parent.parent is not None:
                xml.remove(mesh.parent.parent)
            return
        name = mesh.get("name") or Path(mesh.get("file")).stem
        xml.remove(mesh)
        for other in self._texts.values():
            for geom in [geom for geom in other.root.iter("geom") if geom.get("mesh") == name]:
                other.remove(geom)

    def _find(self, source: Path, reference: str) -> Path | None:
        """Return the file that a model file refers to."""
        folders = _folders(source, self._path, list(self._texts.values()))
        return next(_candidates(reference, folders, self._roots), None)


def _parsed(path: Path) -> XmlText | None:
    """Return a model file; None if it is no XML, so that Drake tells the error."""
    if path.suffix.lower() not in (".urdf", ".sdf", ".xml"):
        return None
    try:
        return XmlText(path.read_bytes())
    except ValueError:
        return None


def _reference(mesh: XmlElement) -> str:
    uri = mesh.find("uri")
    return uri.text.strip() if uri is not None else mesh.get("filename") or mesh.get("file")


def _refer(xml: XmlText, mesh: XmlElement, reference: str) -> None:
    uri = mesh.find("uri")
    if uri is not None:
        xml.set_text(uri, reference)
    elif "filename" in mesh.attributes:
        xml.set(mesh, filename=reference)
    else:
        # In MJCF, a mesh is named like its file.
        xml.set(mesh, name=mesh.get("name") or Path(mesh.get("file")).stem, file=reference)


def _with_blanks(text: str) -> str:
    """Return a vector whose numbers are separated by commas with blanks instead; anything else as it is.

    Commas separate numbers where blanks follow each one, where the numbers have points, or where there are several
    commas and no blanks; otherwise they may be decimal ones.
    """
    if not re.fullmatch(rf"\s*{_NUMBER}(?:\s*,\s*{_NUMBER})+\s*,?\s*", text):
        return text
    numbers = text.replace(",", " ").split()
    is_separator = (
        len(re.findall(r",\s", text)) == len(numbers) - 1
        or any("." in number for number in numbers)
        or (text.count(",") > 1 and len(text.split()) == 1)
    )
    return " ".join(numbers) if is_separator else text


def _is_zero(text: str) -> bool:
    return as_number(text) == 0.0


def _common_folder(paths: list[Path]) -> Path:
    """Return the innermost folder that holds all files."""
    parents = [path.parent for path in paths]
    folder = parents[0] if parents else Path()
    while not all(parent.is_relative_to(folder) for parent in parents):
        folder = folder.parent
    return folder


# -- packages


def find_packages(path: Path, text: str, folders: Mapping[str, Path]) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the folders of the packages that a model file names, and a sentence for each that is not found.

    A package is a folder whose package.xml has its name, or that has its name itself: around the model file or beside
    a folder around it, in a folder of ROS_PACKAGE_PATH, or in ``share`` of one of AMENT_PREFIX_PATH. Drake's own are
    not among them.

    Args:
        path: The model file.
        text: Its text.
        folders: Folders by name, which count first.
    """
    named: dict[str, list[str]] = {}
    for name, rest in _URI.findall(text):
        named.setdefault(name, []).append(rest)
    roots: dict[str, Path] = {}
    missing: dict[str, str] = {}
    for name in sorted(named.keys() - _OF_DRAKE):
        if name in folders:
            roots[name] = folders[name].resolve()
            continue
        candidates = list(_package_folders(path, name))
        # If several have the name, the one that has the file.
        holding = [root for root in candidates if any((root / rest).is_file() for rest in named[name])]
        if candidates:
            roots[name] = [*holding, *candidates][0]
        else:
            missing[name] = _where_to_look(path, name)
    return roots, missing


def _package_folders(path: Path, name: str) -> Iterator[Path]:
    environment = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    environment += [Path(p) / "share" for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    folders = [*path.parents, *environment]
    for folder in folders:
        for xml in (folder / "package.xml", *sorted(folder.glob("*/package.xml"))):
            if _package_name(xml) == name:
                yield xml.parent.resolve()
    for folder in folders:
        if folder.name == name:
            yield folder.resolve()
        elif (folder / name).is_dir():
            yield (folder / name).resolve()


def _package_name(xml: Path) -> str:
    try:
        match = _PACKAGE_NAME.search(xml.read_text("utf-8"))
    except (OSError, UnicodeDecodeError):
        return ""
    return match[1] if match else ""


def _where_to_look(path: Path, name: str) -> str:
    xml = next((folder / "package.xml" for folder in path.parents if (folder / "package.xml").is_file()), None)
    around = f"; {xml} has the <name> {_package_name(xml) or 'of no package'}" if xml else ""
    return (
        f"no folder around the file is named {name} or has a package.xml with this <name>{around}. Say where it is: "
        f"--package {name}=FOLDER, or ROS_PACKAGE_PATH"
    )


# -- files


def closure(path: Path, roots: Mapping[str, Path]) -> list[Path]:
    """Return a model file and the files that it needs, directly or through others.

    Args:
        path: The model file.
        roots: Folder of each ROS package that the files may name, by the name of the package.
    """
    files, texts = [path], {}
    count = 0
    while count != len(files):  # a file that is included may say where those before it look
        count = len(files)
        for source in files:  # grows
            if source not in texts and (xml := _parsed(source)) is not None:
                texts[source] = xml
            files += [f for f in dict.fromkeys(_references(source, path, [*texts.values()], roots)) if f not in files]
    return files


def _references(source: Path, model: Path, texts: list[XmlText], roots: Mapping[str, Path]) -> Iterator[Path]:
    suffix = source.suffix.lower()
    if suffix not in (".urdf", ".sdf", ".xml", ".obj", ".mtl", ".gltf"):
        return
    text = source.read_text(encoding="utf-8", errors="replace")
    is_wavefront = suffix in (".obj", ".mtl")
    folders = [source.parent] if is_wavefront or suffix == ".gltf" else _folders(source, model, texts)
    for reference in (_OBJ_FILE if is_wavefront else _QUOTED_FILE).findall(text):
        yield from _candidates(reference, folders, roots)


def _folders(source: Path, model: Path, texts: list[XmlText]) -> list[Path]:
    """Return the folders in which a model file looks for others: MJCF names some, for all files that it includes."""
    folders = [source.parent, model.parent]
    for xml in texts:
        for compiler in xml.root.iter("compiler"):
            for name in ("meshdir", "texturedir", "assetdir"):
                if directory := compiler.get(name):
                    folders += [source.parent / directory, model.parent / directory]
    return list(dict.fromkeys(folders))


def _candidates(reference: str, folders: list[Path], roots: Mapping[str, Path]) -> Iterator[Path]:
    """Yield the file that a reference names, if it is there."""
    if match := _URI.fullmatch(reference):
        places = [roots[match[1]] / match[2]] if match[1] in roots else []
    else:
        places = [folder / reference.removeprefix("file://") for folder in folders]
    yield from (place.resolve() for place in places if place.is_file())
