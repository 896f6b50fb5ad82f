"""The file modelDescription.xml of an exported FMU."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.fmi.exported_part import ExportedVariable


def model_description(
    variables: Sequence[ExportedVariable], *, name: str, identifier: str, token: str, step: float, is_coupled: bool
) -> bytes:
    """Return the text of modelDescription.xml, FMI 3.0, for co-simulation.

    The value reference of the time is 0, and of the k-th variable 1 + k.

    Args:
        variables: The variables.
        name: The name of the model.
        identifier: The name of the library, without its suffix.
        token: The instantiation token.
        step: The default communication step in s.
        is_coupled: Whether the FMU needs Python on its machine.
    """
    attributes = {"fmiVersion": "3.0", "modelName": name, "instantiationToken": token, "generationTool": "vtbdrake"}
    root = Element("fmiModelDescription", attributes)
    SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        needsExecutionTool=_flag(is_coupled),
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    units = sorted({variable.unit for variable in variables} - {"1"} | {"s"})
    definitions = SubElement(root, "UnitDefinitions")
    for unit in units:
        SubElement(definitions, "Unit", name=unit)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError", description="Why a function has failed")
    SubElement(root, "DefaultExperiment", startTime="0", stepSize=_text([step]))
    listed = SubElement(root, "ModelVariables")
    SubElement(
        listed, "Float64", name="time", valueReference="0", causality="independent", variability="continuous", unit="s"
    )
    structure = SubElement(root, "ModelStructure")
    references = {variable.name: str(1 + k) for k, variable in enumerate(variables)}
    for variable in variables:
        _add(listed, variable, references[variable.name])
    for element in ("Output", "InitialUnknown"):
        for variable in variables:
            if variable.causality == "output":
                SubElement(structure, element, valueReference=references[variable.name])
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _add(parent: Element, variable: ExportedVariable, reference: str) -> None:
    attributes = {"name": variable.name, "valueReference": reference, "causality": variable.causality}
    if variable.causality == "parameter":
        attributes["variability"] = "fixed" if variable.is_fixed else "tunable"
    if variable.name != variable.address:
        attributes["description"] = variable.address
    if variable.unit != "1":
        attributes["unit"] = variable.unit
    if variable.start is not None:
        attributes["start"] = _text(variable.start)
        for bound, values in (("min", variable.lower), ("max", variable.upper)):
            # One number stands for all entries.
            if np.isfinite(values).all() and np.ptp(values) == 0.0:
                attributes[bound] = _text(values[:1])
    element = SubElement(parent, "Float64", attributes)
    for length in variable.shape:
        SubElement(element, "Dimension", start=str(length))


def _text(values: Array | Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _flag(value: bool) -> str:
    return "true" if value else "false"
