"""The XML files of an FMU: `modelDescription.xml` and `sources/buildDescription.xml`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np

from dcvrt import __version__
from dcvrt.dae import Dae, Row
from dcvrt.fmi.model_code import TOKEN
from dcvrt.fmi.unit_definitions import base_unit
from dcvrt.fmi.variables import Layout, identifier, nominals, structured
from dcvrt.units import BASES, dimension

LICENCE = "GPL-3.0-or-later"
LOG_CATEGORIES = {
    "logEvents": "jumps of the modes, with the row that fired and those that tied with it",
    "logStatusWarning": "a state left its range of validity",
    "logStatusDiscard": "the equations gave no number",
    "logStatusError": "what a caller did wrong, or why there is no result",
}


def model_description(layout: Layout, doc: str) -> str:
    """Text of `modelDescription.xml`, with a placeholder for the instantiation token."""
    dae = layout.dae
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=dae.name,
        instantiationToken=TOKEN,
        description=doc or f"{dae.name}, compiled by dcvrt",
        license=LICENCE,
        generationTool=f"dcvrt {__version__}",
        variableNamingConvention="structured",
    )
    ET.SubElement(
        root,
        "ModelExchange",
        modelIdentifier=identifier(dae.name),
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        providesDirectionalDerivatives="true",
        needsCompletedIntegratorStep="true",
        providesEvaluateDiscreteStates="true",
    )
    _units(root, dae)
    _mode_types(root, dae)
    categories = ET.SubElement(root, "LogCategories")
    for name, meaning in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=name, description=meaning)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", tolerance="1e-6")
    _variables(ET.SubElement(root, "ModelVariables"), layout)
    _structure(ET.SubElement(root, "ModelStructure"), layout)
    return _text(root)


def build_description(name: str, sources: Iterable[str]) -> str:
    """Text of `sources/buildDescription.xml`: how to compile the sources anew."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(
        root,
        "BuildConfiguration",
        modelIdentifier=identifier(name),
        description="one shared library from all C files; links the mathematical library",
    )
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for source in sources:
        ET.SubElement(files, "SourceFile", name=source)
    ET.SubElement(files, "IncludeDirectory", name=".")
    return _text(root)


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


# -- units and types ----------------------------------------------------------------------------------------


def _units(root: ET.Element, dae: Dae) -> None:
    rows = (*dae.states, *dae.algebraics, *dae.inputs, *dae.parameter_rows, *dae.outputs)
    units = {row.unit for row in rows} | {rate_unit(row.unit) for row in dae.states} | {"s"}
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted(units):
        element = ET.SubElement(definitions, "Unit", name=unit)
        ET.SubElement(element, "BaseUnit", base_unit(unit))
        kinds = "; ".join(f"{base}: {BASES[base]}" for base, _ in dimension(unit) if base.startswith("pu("))
        if kinds:
            notes = ET.SubElement(element, "Annotations")
            ET.SubElement(notes, "Annotation", type="dcvrt").text = kinds


def rate_unit(unit: str) -> str:
    """Unit of the time derivative of a quantity.

    >>> rate_unit("rad"), rate_unit("1"), rate_unit("pu(S) s")
    ('rad/s', '1/s', 'pu(S) s/s')
    """
    return f"{unit}/s"


def _mode_types(root: ET.Element, dae: Dae) -> None:
    if not dae.automata:
        return
    types = ET.SubElement(root, "TypeDefinitions")
    for automaton in dae.automata:
        kind = ET.SubElement(
            types,
            "EnumerationType",
            name=_mode_type(automaton.path),
            description=f"modes of {automaton.path}",
        )
        for number, mode in enumerate(automaton.modes):
            rows = "; ".join(row.text for row in automaton.rows if row.source == mode)
            ET.SubElement(kind, "Item", name=mode, value=str(number), description=rows or "no way out")


def _mode_type(path: str) -> str:
    return f"{structured(path)}.Mode"


# -- variables ----------------------------------------------------------------------------------------------


def _variables(parent: ET.Element, layout: Layout) -> None:
    dae = layout.dae

    def add(row: Row, reference: int, name: str = "", unit: str = "", **attributes: str) -> None:
        described = row.doc or attributes.pop("otherwise", row.path)
        attributes.pop("otherwise", None)
        ET.SubElement(
            parent,
            "Float64",
            {
                "name": name or structured(row.path),
                "valueReference": str(reference),
                "description": described,
                **attributes,
                "unit": unit or row.unit,
            },
        )

    time = Row("time", "s", doc="time")
    add(time, layout.first.time, causality="independent", variability="continuous")
    reset = {state for _, row in layout.rows for state in row.reset}
    sizes = nominals(dae)
    for k, row in enumerate(dae.states):
        extra = {"reinit": "true"} if k in reset else {}
        extra |= {"nominal": _number(sizes[k])} if sizes[k] != 1.0 else {}
        local = {"causality": "local", "variability": "continuous", "initial": "calculated"}
        add(row, layout.first.x + k, otherwise=f"state {row.path}", **local, **extra)
    for k, row in enumerate(dae.states):
        add(
            Row(row.path, row.unit, doc=f"rate of {row.path}"),
            layout.first.f + k,
            name=f"der({structured(row.path)})",
            unit=rate_unit(row.unit),
            causality="local",
            variability="continuous",
            initial="calculated",
            derivative=str(layout.first.x + k),
        )
    for k, row in enumerate(dae.inputs):
        add(row, layout.first.u + k, causality="input", variability="continuous", start=_number(row.value))
    for k, row in enumerate(dae.parameter_rows):
        described = f"{row.doc or row.path} [{row.source}]" if row.source else row.doc
        add(
            Row(row.path, row.unit, doc=described),
            layout.first.p + k,
            causality="parameter",
            variability="fixed",
            initial="exact",
            **_bounds(row),
            start=_number(row.value),
        )
    for k, row in enumerate(dae.outputs):
        add(row, layout.first.y + k, causality="output", variability="continuous", initial="calculated")
    for k, row in enumerate(dae.algebraics):
        add(row, layout.first.z + k, causality="local", variability="continuous", initial="calculated")
    for k, (name, text) in enumerate(zip(layout.indicator_names(), layout.indicator_texts(), strict=True)):
        # the unit of a guard is that of what it compares, which the system does not tell
        ET.SubElement(
            parent,
            "Float64",
            name=name,
            valueReference=str(layout.first.h + k),
            description=text,
            causality="local",
            variability="continuous",
            initial="calculated",
        )
    for k, automaton in enumerate(dae.automata):
        ET.SubElement(
            parent,
            "Enumeration",
            name=mode_name(dae, automaton.path),
            valueReference=str(layout.first.mode + k),
            description=f"mode of {automaton.path}; starts in {automaton.start}",
            causality="output",
            variability="discrete",
            initial="calculated",
            declaredType=_mode_type(automaton.path),
        )


def mode_name(dae: Dae, path: str) -> str:
    """Name of the mode of an automaton: `block.mode`, or `block.mode[1]` when the block has such a symbol."""
    taken = {*dae.x_names, *dae.u_names, *dae.p_names, *dae.y_names, *(r.path for r in dae.algebraics)}
    name = f"{path}.mode"
    return structured(path) + (".mode[1]" if name in taken else ".mode")


def _bounds(row: Row) -> dict[str, str]:
    low, high = row.bounds
    return {name: _number(value) for name, value in (("min", low), ("max", high)) if np.isfinite(value)}


def _number(value: float) -> str:
    return repr(float(value))


# -- structure ----------------------------------------------------------------------------------------------


def _structure(parent: ET.Element, layout: Layout) -> None:
    dae = layout.dae
    nx, ny, na = len(dae.states), len(dae.outputs), len(dae.automata)

    def list_unknowns(kind: str, first: int, dependencies: Sequence[tuple[int, ...]]) -> None:
        for k, references in enumerate(dependencies):
            known = " ".join(map(str, references))
            ET.SubElement(parent, kind, valueReference=str(first + k), dependencies=known)

    list_unknowns("Output", layout.first.y, layout.dependencies(layout.y))
    for k in range(na):  # a mode may follow from anything: no list says that
        ET.SubElement(parent, "Output", valueReference=str(layout.first.mode + k))
    list_unknowns("ContinuousStateDerivative", layout.first.f, layout.dependencies(layout.f))
    for first, count in (
        (layout.first.x, nx),
        (layout.first.f, nx),
        (layout.first.y, ny),
        (layout.first.mode, na),
    ):
        for k in range(count):  # the equilibrium ties every value to every parameter and input
            ET.SubElement(parent, "InitialUnknown", valueReference=str(first + k))
    list_unknowns("EventIndicator", layout.first.h, layout.dependencies(layout.h))
