"""A generating unit: machine, exciter, governor and stabiliser wired to one diagram."""

from __future__ import annotations

from typing import Any

from dcvrt.dae import Dae
from dcvrt.errors import InputError
from dcvrt.models.block import Block
from dcvrt.models.declared import Input, Part, Port
from dcvrt.models.diagram import Diagram
from dcvrt.models.machines.fixed import FixedField, FixedPower, NoStabiliser
from dcvrt.models.machines.frequency import BusFrequency
from dcvrt.models.machines.parts import UnitBlock
from dcvrt.models.netlist import netlist
from dcvrt.models.phasor import Phasor

FIELD = ("exciter.v_ref", "exciter.regulator.v_ref", "exciter.v_f0", "device.p_0")
POWER = ("governor.p_ref", "device.q_0")


def unit(
    machine: Block,
    exciter: Part | None = None,
    governor: Part | None = None,
    stabiliser: Part | None = None,
    frequency: Part | None = None,
) -> Diagram:
    """Wire a unit. All its quantities are per unit on one common power base.

    Parameters
    ----------
    machine : `GenRou` or `GenCls`.
    exciter : without one the field voltage is constant, `FixedField`.
    governor : without one the torque is constant, `FixedPower`.
    stabiliser : may be left out; needs an exciter.
    frequency : meter for a stabiliser that reads the frequency of the terminal; `BusFrequency()` by default,
        left out where nothing reads it.

    Returns
    -------
    Diagram
        Parts `machine`, `exciter`, `governor`, `stabiliser`, and `frequency` where the stabiliser measures
        that of its bus. Input `v`, the terminal voltage in the network frame at omega_0. Outputs `i`, the
        current INTO the network (generator convention, opposite to the load convention of a facility),
        `delta`, `omega`, `v_f`, `t_m`, `t_e`.

    >>> from dcvrt.models.machines import GenCls, setpoints
    >>> dae = unit(GenCls()).compile()
    >>> dae.x_names, setpoints(dae)
    (('machine.delta', 'machine.omega'), ('exciter.v_f0', 'governor.p_ref'))
    """
    d = Diagram("unit")
    v = d.input("v", "pu(V)", Phasor, doc="terminal voltage, network frame")
    parts: dict[str, Any] = {
        "machine": d.add("machine", machine),
        "exciter": d.add("exciter", exciter if exciter is not None else FixedField()),
        "governor": d.add("governor", governor if governor is not None else FixedPower()),
        "stabiliser": d.add("stabiliser", stabiliser if stabiliser is not None else NoStabiliser()),
    }
    if stabiliser is not None and "v_s" not in parts["exciter"].declared(Input):
        raise InputError(
            f"unit: the stabiliser {stabiliser.label} has nothing to act on: {parts['exciter'].label} takes "
            "no signal. Give the unit an exciter, or leave the stabiliser out."
        )
    sources: dict[str, Port] = {"v": v}
    for name in ("i", "delta", "omega", "t_e", "i_f"):
        sources[name] = getattr(parts["machine"], name)
    sources["v_f"] = parts["exciter"].v_f
    sources["t_m"], sources["p_set"] = parts["governor"].t_m, parts["governor"].p_set
    sources["v_s"] = parts["stabiliser"].v_s
    sources["f"] = sources["omega"]  # no stabiliser reads it that does not ask for the meter
    if getattr(stabiliser, "needs_frequency", False):
        parts["frequency"] = d.add("frequency", frequency if frequency is not None else BusFrequency())
        sources["f"] = parts["frequency"].f
    for part in parts.values():
        for name in part.declared(Input):
            if name not in sources:
                raise InputError(
                    f"unit: {part.label} has an input {name!r}, which nothing in a unit feeds. "
                    f"Known: {', '.join(sources)}."
                )
            d.connect(sources[name], getattr(part, name))
    for name in ("i", "delta", "omega", "v_f", "t_m", "t_e"):
        d.output(name, sources[name])
    return d


def alone(block: UnitBlock) -> Diagram:
    """A block that is a unit by itself, at `device`: a load, a converter.

    >>> from dcvrt.models.machines import ZipLoad, setpoints
    >>> setpoints(alone(ZipLoad(a_z=0.4)).compile())
    ('device.p_0', 'device.q_0')
    """
    d = Diagram(block.label)
    device = d.add("device", block)
    d.connect(d.input("v", "pu(V)", Phasor, doc="terminal voltage, network frame"), device.v)
    d.output("i", device.i)
    return d


def setpoints(dae: Dae) -> tuple[str, str]:
    """Paths of the two parameters of a unit that the power flow decides: of the field, and of the power; of
    a load or converter its two powers.

    Raises
    ------
    InputError
        the system is not that of one unit.
    """
    found = [path for path in FIELD if path in dae.p_names], [path for path in POWER if path in dae.p_names]
    if [len(paths) for paths in found] != [1, 1]:
        raise InputError(
            f"{dae.name}: not the system of one unit: it has {len(found[0])} set-points of the field "
            f"({', '.join(FIELD)}) and {len(found[1])} of the power ({', '.join(POWER)}). "
            "Compile what machines.unit() returned."
        )
    return found[0][0], found[1][0]


def structure(diagram: Diagram) -> tuple[Any, ...]:
    """What decides the equations of a unit; hashable. Units that agree in it share one compiled system.

    It holds the classes of the blocks, which of their time constants and optional terms are 0, saliency and
    the input of the stabiliser. All else are parameters.
    """
    key = []
    for path, block in netlist(diagram).blocks.items():
        if not isinstance(block, UnitBlock):
            raise InputError(
                f"{path} ({block.label}) does not say what decides its equations. Derive it from UnitBlock."
            )
        key.append((path, *block.form()))
    return tuple(key)
