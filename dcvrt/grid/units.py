"""The generating units of a case: their blocks, with the numbers that ANDES computes with.

Reads a system that ANDES has set up, so that values are per unit on the system base; imports nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import isnan, radians
from types import MappingProxyType
from typing import Any

import numpy as np

from dcvrt.errors import InputError, raise_all
from dcvrt.models import machines
from dcvrt.models.declared import Part
from dcvrt.models.diagram import Diagram
from dcvrt.models.netlist import netlist

Values = Mapping[str, float]

ROLES = ("machine", "exciter", "governor", "stabiliser", "frequency")

# -- what becomes of a device -------------------------------------------------------------------------------

Read = Callable[[str], float]


def _renamed(kind: type[machines.UnitBlock], names: str) -> Callable[[Read], Part]:
    """Make a block from values under other names, written "T_R=TR K_A=KA"."""
    pairs = [pair.split("=") for pair in names.split()]
    return lambda read: kind(**{ours: read(theirs) for ours, theirs in pairs})


def _saturated(values: dict[str, float], points: tuple[float, float, float, float]) -> dict[str, float]:
    """Values with onset and gain of the saturation through two points (E1, SE1, E2, SE2)."""
    onset, gain = machines.quadratic(*points)
    return values | {"S_A": onset, "S_B": gain}


def _genrou(read: Read) -> Part:
    names = dict(
        M="M", D="D", f_B="fn", r_a="ra", x_l="xl", x_d="xd", x_q="xq", x_d1="xd1", x_q1="xq1", x_d2="xd2",
        x_q2="xq2", T_d1="Td10", T_q1="Tq10", T_d2="Td20", T_q2="Tq20",
    )  # fmt: skip
    values = {ours: read(theirs) for ours, theirs in names.items()}
    return machines.GenRou(**_saturated(values, (1.0, read("S10"), 1.2, read("S12"))))


def _ieeet1(read: Read) -> Part:
    names = dict(T_R="TR", K_A="KA", T_A="TA", V_Rmin="VRMIN", K_E="KE", T_E="TE", K_F="KF", T_F="TF")
    values = {ours: read(theirs) for ours, theirs in names.items()}
    values["V_Rmax"] = read("VRMAX") or machines.UNLIMITED
    return machines.Ieeet1(**_saturated(values, _points(read)))


def _exdc2(kind: type[machines.Exdc2]) -> Callable[[Read], Part]:
    names = dict(
        T_R="TR", T_C="TC", T_B="TB", K_A="KA", T_A="TA", V_Rmin="VRMIN", V_Rmax="VRMAX", K_E="KE", T_E="TE",
        K_F="KF1", T_F="TF1",
    )  # fmt: skip
    return lambda read: kind(
        **_saturated({ours: read(theirs) for ours, theirs in names.items()}, _points(read))
    )


def _points(read: Read) -> tuple[float, float, float, float]:
    return read("E1"), read("SE1"), read("E2"), read("SE2")


def _sexs(read: Read) -> Part:
    return machines.Sexs(
        K=read("K"),
        T_A=read("TATB") * read("TB"),
        T_B=read("TB"),
        T_E=read("TE"),
        E_min=read("EMIN"),
        E_max=read("EMAX"),
    )


def _esst3a(read: Read) -> Part:
    names = dict(
        T_R="TR", V_Imin="VIMIN", V_Imax="VIMAX", T_C="TC", T_B="TB", K_A="KA", T_A="TA", V_Rmin="VRMIN",
        V_Rmax="VRMAX", K_P="KP", K_I="KI", X_L="XL", K_C="KC", V_Bmax="VBMAX", K_M="KM", T_M="TM",
        V_Mmin="VMMIN", V_Mmax="VMMAX", K_G="KG", V_Gmax="VGMAX",
    )  # fmt: skip
    values = {ours: read(theirs) for ours, theirs in names.items()}
    return machines.esst3a(**values, theta_P=radians(read("THETAP")))


def _ieeeg1(read: Read) -> Part:
    names = dict(
        K="K", T_1="T1", T_2="T2", T_3="T3", U_o="UO", U_c="UC", P_min="PMIN", P_max="PMAX", T_4="T4",
        T_5="T5", T_6="T6", T_7="T7",
    )  # fmt: skip
    total = sum(read(f"K{k}") for k in range(1, 9))
    if total == 0:
        raise InputError("K1 to K8 are all 0. Give the shares of the stages, which add up to 1.")
    shares = {f"K_{k}": read(f"K{k}") / total for k in (1, 3, 5, 7)}
    return machines.Ieeeg1(**{ours: read(theirs) for ours, theirs in names.items()}, **shares)


def _ieeest(read: Read) -> Part:
    names = dict(
        signal="MODE", share="share", K_S="KS", L_min="LSMIN", L_max="LSMAX",
        **{f"A_{k}": f"A{k}" for k in range(1, 7)}, **{f"T_{k}": f"T{k}" for k in range(1, 7)},
    )  # fmt: skip
    values = {ours: read(theirs) for ours, theirs in names.items()}
    low, high = read("VCL"), read("VCU")
    if low == 0 and high == 0:
        return machines.Ieeest(**values)
    return machines.IeeestWithWindow(
        **values, V_CL=low or -machines.UNLIMITED, V_CU=high or machines.UNLIMITED
    )


def _st2cut(read: Read) -> Part:
    names = dict(
        share="share", K_1="K1", K_2="K2", L_min="LSMIN", L_max="LSMAX",
        **{f"T_{k}": f"T{k}" for k in range(1, 11)},
    )  # fmt: skip
    signals = {ours: _signal(read(theirs)) for ours, theirs in (("signal_1", "MODE"), ("signal_2", "MODE2"))}
    return machines.St2Cut(**{ours: read(theirs) for ours, theirs in names.items()}, **signals)


def _signal(mode: float) -> float:
    """The number of an input; one that the data leave open is none."""
    return 0.0 if isnan(mode) else mode


_TGOV1 = "R=R V_min=VMIN V_max=VMAX T_1=T1 T_2=T2 T_3=T3 D_t=Dt"
MADE: Mapping[str, Mapping[str, Callable[[Read], Part]]] = {
    "machine": {
        "GENROU": _genrou,
        "GENCLS": _renamed(machines.GenCls, "M=M D=D f_B=fn r_a=ra x_d1=xd1"),
    },
    "exciter": {
        "IEEET1": _ieeet1,
        "EXDC2": _exdc2(machines.Exdc2),
        "IEEEX1": _exdc2(machines.Ieeex1),
        "SEXS": _sexs,
        "EXST1": _renamed(
            machines.Exst1,
            "T_R=TR V_Imin=VIMIN V_Imax=VIMAX T_C=TC T_B=TB K_A=KA T_A=TA V_Rmin=VRMIN V_Rmax=VRMAX K_C=KC "
            "K_F=KF T_F=TF",
        ),
        "ESST3A": _esst3a,
    },
    "governor": {
        "TGOV1": _renamed(machines.Tgov1, _TGOV1),
        "TGOV1N": _renamed(machines.Tgov1N, _TGOV1),
        "IEEEG1": _ieeeg1,
    },
    "stabiliser": {"IEEEST": _ieeest, "ST2CUT": _st2cut},
}
"""Models of ANDES that have a block here, by the part that they play in a unit."""

NETWORK = {"Bus", "Line", "PQ", "PV", "Slack", "Shunt"}
"""What the network itself is made of."""

IDLE = {
    "Area": "groups buses",
    "Zone": "groups buses",
    "Region": "groups buses",
    "Owner": "groups devices",
    "ACE": "adds up the exchange of an area; nothing reads it unless a secondary control is there too",
    "ACEc": "adds up the exchange of an area; nothing reads it unless a secondary control is there too",
    "BusFreq": "measures; a stabiliser that reads it has it inside its unit",
    "BusROCOF": "measures",
    "PMU": "measures",
    "PLL1": "measures; a converter that reads it is listed itself",
    "PLL2": "measures; a converter that reads it is listed itself",
    "FreqDiv": "measures",
    "COI": "averages angle and speed of machines for display",
    "COI2": "averages angle and speed of machines for display",
    "Fault": "an event: faults are stated with the simulation",
    "Fault1P": "an event: faults are stated with the simulation",
    "Toggle": "an event: events are stated with the simulation",
    "Toggler": "an event: events are stated with the simulation",
    "Alter": "an event: events are stated with the simulation",
    "Output": "chooses what is written to a file",
    "Summary": "holds text",
    "GCost": "holds costs",
    "PQBusLoad": "holds a series of loads",
}
"""Models that may stand in a case without effect on a fault simulation, and why."""


@dataclass(frozen=True)
class Unit:
    """A machine with its controls, as a case states it.

    Parameters
    ----------
    bus : int
        Number of its bus.
    name : str
        As messages name it, e.g. ``GENROU 'GENROU_1'``.
    generator : object
        Name of the generator of the power flow that it stands for.
    share_p, share_q : float
        Its shares of the active and reactive power of that generator.
    recipe : mapping of part to a function that makes its block
        `machine`, and those of `exciter`, `governor`, `stabiliser` and `frequency` that it has.
    """

    bus: int
    name: str
    generator: Any
    share_p: float
    share_q: float
    recipe: Mapping[str, Callable[[], Part]]

    def diagram(self) -> Diagram:
        """A new diagram of the unit, with its values."""
        return machines.unit(**{part: make() for part, make in self.recipe.items()})  # type: ignore[arg-type]

    @cached_property
    def structure(self) -> tuple[Any, ...]:
        """What decides its equations: units that agree in it share a compiled system."""
        return machines.structure(self.diagram())

    @cached_property
    def values(self) -> Values:
        """Values of the parameters by path, set-points at their defaults until an initialisation."""
        flat = netlist(self.diagram())
        return MappingProxyType(
            {
                f"{path}.{name}": value
                for path, block in flat.blocks.items()
                for name, value in block.values.items()
            }
        )


# -- reading a system ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Device:
    """One device of an ANDES system."""

    model: str
    columns: Any
    place: int

    @property
    def idx(self) -> Any:
        return self.columns.idx.v[self.place]

    def __str__(self) -> str:
        return f"{self.model} {self.idx!r}"

    def __getitem__(self, name: str) -> Any:
        return getattr(self.columns, name).v[self.place]


def _devices(system: Any, model: str) -> Iterator[Device]:
    """Devices of a model that are in service."""
    columns = system.models.get(model)
    for place in range(columns.n if columns is not None else 0):
        if columns.u.v[place]:
            yield Device(model, columns, place)


def read_units(system: Any) -> list[Unit]:
    """The units of a case, in the order of its machines.

    Parameters
    ----------
    system : set up by ANDES. After its initialisation, limits that it has widened are read as it left them.

    Raises
    ------
    InputError
        values that a block does not take, two controls of one kind at a machine; all at once. Models that
        have no block are not looked at: ask `unsupported` first.
    """
    controls = {part: _controls(system, part) for part in ("exciter", "governor")}
    of_exciter: dict[tuple[str, Any], Device] = {}
    problems, found = [], []
    for table in controls.values():
        for syn, devices in table.items():
            if len(devices) > 1:
                problems.append(
                    f"machine {syn!r} has {len(devices)} controls of one kind: "
                    f"{', '.join(map(str, devices))}. Keep one of them."
                )
    for model in MADE["stabiliser"]:
        for device in _devices(system, model):
            key = ("exciter", device["avr"])
            if key in of_exciter:
                problems.append(f"{device} and {of_exciter[key]} act on one exciter. Keep one of them.")
            of_exciter[key] = device
    for model in MADE["machine"]:
        for machine in _devices(system, model):
            parts = {"machine": machine}
            for part, table in controls.items():
                if machine.idx in table:
                    parts[part] = table[machine.idx][0]
            stabiliser = of_exciter.get(("exciter", parts["exciter"].idx)) if "exciter" in parts else None
            if stabiliser is not None:
                parts["stabiliser"] = stabiliser
            recipe = {part: _recipe(system, part, device, machine) for part, device in parts.items()}
            if stabiliser is not None and _reads_frequency(stabiliser):
                recipe["frequency"] = _frequency(system, stabiliser)
            unit = Unit(
                bus=int(machine["bus"]),
                name=str(machine),
                generator=machine["gen"],
                share_p=float(machine["gammap"]),
                share_q=float(machine["gammaq"]),
                recipe=MappingProxyType(recipe),
            )
            for part, make in recipe.items():
                try:
                    make()
                except InputError as error:
                    stated = parts.get(part, stabiliser)
                    problems.append(f"{unit.name} at bus {unit.bus}, {stated}: {error}")
            found.append((system.SynGen.idx2uid(machine.idx), unit))
    raise_all(problems, "units of the case", InputError)
    return [unit for _, unit in sorted(found, key=lambda pair: pair[0])]


def _controls(system: Any, part: str) -> dict[Any, list[Device]]:
    """Devices of the models of a part, by the machine that they stand at."""
    table: dict[Any, list[Device]] = {}
    for model in MADE[part]:
        for device in _devices(system, model):
            table.setdefault(device["syn"], []).append(device)
    return table


def _recipe(system: Any, part: str, device: Device, machine: Device) -> Callable[[], Part]:
    """How the block of a device is made."""
    make = MADE[part][device.model]
    rating = float(machine["Sn"]) / float(system.config.mva)

    def read(name: str) -> float:
        return rating if name == "share" else float(device[name])

    return lambda: make(read)


def _reads_frequency(stabiliser: Device) -> bool:
    """Whether one of its inputs is the frequency of its bus."""
    return any(hasattr(stabiliser.columns, name) and stabiliser[name] == 2 for name in ("MODE", "MODE2"))


def _frequency(system: Any, stabiliser: Device) -> Callable[[], Part]:
    """The meter of a stabiliser."""
    name = "busfreq" if stabiliser["MODE"] == 2 else "busfreq2"
    meters = system.BusFreq
    place = list(meters.idx.v).index(stabiliser[name])
    return lambda: machines.BusFrequency(
        f_B=float(meters.fn.v[place]), T_f=float(meters.Tf.v[place]), T_w=float(meters.Tw.v[place])
    )


# -- what has no block --------------------------------------------------------------------------------------


def unsupported(system: Any) -> list[tuple[str, int, list[str]]]:
    """Models of a case without a counterpart here: name of the model, number and names of the devices.

    Devices out of service do not count. A device whose model has a block but which uses it in a way that
    the block does not know is listed under the model and what it asks for. Models that act on nothing in a
    fault simulation (`IDLE`) are left out. A generator of the power flow that no dynamic device stands for
    would hold its voltage through a fault, and is listed too.
    """
    known = NETWORK | set(IDLE) | {model for models in MADE.values() for model in models}
    found: dict[str, list[str]] = {}
    for name in system.models:
        for device in _devices(system, name) if hasattr(system.models[name], "u") else ():
            if name not in known:
                found.setdefault(name, []).append(str(device.idx))
                continue
            for use in _uses(device):
                found.setdefault(f"{name} with {use}", []).append(str(device.idx))
    stood_for = {
        device["gen"]
        for name, columns in system.models.items()
        if hasattr(columns, "gen") and hasattr(columns, "u")
        for device in _devices(system, name)
    }
    for name in ("PV", "Slack"):
        for device in _devices(system, name):
            if device.idx not in stood_for:
                found.setdefault(f"{name} without a machine", []).append(str(device.idx))
    return [(model, len(names), names) for model, names in found.items()]


def _uses(device: Device) -> Iterator[str]:
    """What a device asks for that its block does not know."""
    model = device.model
    if model in MADE["governor"] and device["wref0"] != 1:
        yield f"a speed reference of {float(device['wref0']):g}"
    if model == "IEEEG1" and _given(device["syn2"]):
        yield "a second machine (syn2)"
    if model in MADE["stabiliser"]:
        modes = [name for name in ("MODE", "MODE2") if hasattr(device.columns, name)]
        for name in modes:
            mode = _signal(float(device[name]))
            if mode not in (0, 1, 2, 3, 4, 5):
                yield f"{name} {mode:g}"
        for name, bus, meter in (("MODE", "busr", "busf"), ("MODE2", "busr2", "busf2")):
            if name not in modes:
                continue
            remote = _given(device[bus]) and device[bus] != device["bus"]
            if remote and (device[name] in (2, 5) or device["VCU"] or device["VCL"]):
                yield f"a remote bus ({bus})"
            if device[name] == 2 and _given(device[meter]) and not remote and _elsewhere(device, meter):
                yield f"a meter at another bus ({meter})"
    if model == "ST2CUT" and (device["VCU"] or device["VCL"]):
        yield "a window of the voltage (VCU, VCL)"
    if model == "ST2CUT" and _signal(float(device["MODE2"])) == 2 and float(device["MODE"]) == 2:
        one, two = device["busfreq"], device["busfreq2"]
        if one != two:
            yield "two frequency meters"


def _elsewhere(device: Device, meter: str) -> bool:
    """Whether a frequency meter does not stand at the bus of the machine."""
    meters = device.columns.system.BusFreq
    return bool(meters.bus.v[list(meters.idx.v).index(device[meter])] != device["bus"])


def _given(value: Any) -> bool:
    """Whether an optional reference is there."""
    return value is not None and not (isinstance(value, (float, np.floating)) and np.isnan(value))
