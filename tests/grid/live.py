"""Cases that ANDES has read and initialised, and its states and set-points under our names."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from dcvrt.dae import Dae
from dcvrt.grid import andes, dynamics118
from dcvrt.grid.network import Network
from dcvrt.grid.units import MADE, Unit, read_units
from dcvrt.models.machines import setpoints

CASES = {
    "kundur": ("kundur/kundur_full.xlsx", None),
    "ieee14": ("ieee14/ieee14.raw", "ieee14/ieee14.dyr"),
    "ieee39": ("ieee39/ieee39_full.xlsx", None),
}
FURTHER = {
    "sexs": ("kundur/kundur_sexs.xlsx", None),
    "exst1": ("kundur/kundur_exst1.xlsx", None),
    "esst3a": ("kundur/kundur_esst3a.xlsx", None),
    "ieeet1": ("ieee14/ieee14_ieeet1.xlsx", None),
    "ieeest": ("kundur/kundur_ieeest.xlsx", None),
    "frequency": ("kundur/kundur_ieeest.xlsx", None),
    "npcc": ("npcc/npcc.xlsx", None),
}
"""Cases for models that the others lack; npcc has GENCLS, `frequency` lets the stabilisers read that."""

STATES = {
    "GENROU": dict(delta="delta", omega="omega", e_q1="e1q", e_d1="e1d", e_d2="e2d", e_q2="e2q"),
    "GENCLS": dict(delta="delta", omega="omega"),
    "IEEET1": dict(v_m="LG_y", v_r="LA_y", e_f="INT_y", w="WF_x"),
    "EXDC2": dict(v_m="LS_y", x="LL_x", v_r="LA_y", e_f="vp", w="W_x"),
    "IEEEX1": dict(v_m="LS_y", x="LL_x", v_r="LA_y", e_f="vp", w="W_x"),
    "SEXS": dict(x="LL_x", e_f="LAW_y"),
    "EXST1": dict(v_m="LG_y", x="LL_x", v_r="LR_y", w="WF_x"),
    "ESST3A": {
        "regulator.v_m": "LG_y",
        "regulator.x": "LL_x",
        "regulator.v_r": "LAW1_y",
        "field.v_k": "LAW2_y",
    },
    "TGOV1": dict(g="LAG_y", x="LL_x"),
    "TGOV1N": dict(g="LAG_y", x="LL_x"),
    "IEEEG1": dict(x="LL_x", g="IAW_y", y_4="L4_y", y_5="L5_y", y_6="L6_y", y_7="L7_y"),
    "IEEEST": dict(r_1="F1_x", y_1="F1_y", r_2="F2_x1", y_2="F2_x2", x_1="LL1_x", x_2="LL2_x", x_3="WO_x"),
    "ST2CUT": dict(y_1="L1_y", y_2="L2_y", x_0="WO_x", x_1="LL1_x", x_2="LL2_x", x_3="LL3_x"),
    "BusFreq": dict(theta="L_y", x="WO_x"),
}
SETPOINT = {model: "vref0" for model in MADE["exciter"]} | {
    "TGOV1": "pref0",
    "TGOV1N": "pref0",
    "IEEEG1": "tm012",
}


def package() -> Path:
    """Folder of the cases that ANDES brings along."""
    return andes.case118().parent.parent


@cache
def system(case: str) -> Any:
    """A case after power flow and initialisation."""
    return fresh(case)


def fresh(case: str, fault: int | None = None) -> Any:
    """A case of one's own, with a fault device (switched off) on request."""
    if case == "ieee118":
        ss = andes.read(andes.case118())
        with andes.quiet():
            andes.add_machines(ss, dynamics118.machines(Network.ieee118()))
    else:
        path, dynamics = (CASES | FURTHER)[case]
        ss = andes.read(package() / path, package() / dynamics if dynamics else None)
    with andes.quiet():
        if fault is not None:
            ss.add("Fault", {"idx": "fault", "bus": fault, "tf": 1e3, "tc": 2e3, "xf": 1e-4, "rf": 0.0})
        if case == "frequency":
            ss.IEEEST.MODE.v = [2.0] * ss.IEEEST.n
            ss.Toggle.u.v = [0.0] * ss.Toggle.n
        ss.setup()
        ss.PFlow.run()
        ss.TDS.config.no_tqdm = 1
        ss.TDS.init()
    return ss


def place(ss: Any, model: str, idx: Any) -> int:
    return list(ss.models[model].idx.v).index(idx)


def controls(ss: Any, unit: Unit) -> dict[str, tuple[str, int]]:
    """Model of ANDES and position in it, of every part of a unit."""
    model, name = unit.name.split(" ", 1)
    machine = next(k for k, idx in enumerate(ss.models[model].idx.v) if repr(idx) == name)
    found = {"machine": (model, machine)}
    for part, reference in (("exciter", "syn"), ("governor", "syn"), ("stabiliser", "avr")):
        of = found["exciter"] if part == "stabiliser" and "exciter" in found else found["machine"]
        owner = ss.models[of[0]].idx.v[of[1]]
        for candidate in MADE[part]:
            columns = ss.models[candidate]
            for k in range(columns.n):
                if part in unit.recipe and getattr(columns, reference).v[k] == owner:
                    found[part] = (candidate, k)
    if "frequency" in unit.recipe:
        stabiliser = ss.models[found["stabiliser"][0]]
        found["frequency"] = ("BusFreq", place(ss, "BusFreq", stabiliser.busfreq.v[found["stabiliser"][1]]))
    return found


def state(ss: Any, unit: Unit, dae: Dae, columns: Any = None) -> np.ndarray:
    """ANDES's states of a unit in the order of the compiled one: now, or rows of its trajectory."""
    where = controls(ss, unit)
    picked = []
    for path in dae.x_names:
        part, _, name = path.partition(".")
        model, k = where[part]
        variable = getattr(ss.models[model], STATES[model][name])
        offset = ss.BusFreq.a0.v[k] if model == "BusFreq" else 0.0
        picked.append((variable.v[k] if columns is None else columns[:, variable.a[k]]) + offset)
    return np.array(picked, dtype=float)


def values(ss: Any, unit: Unit, dae: Dae) -> np.ndarray:
    """Parameters of a unit with the set-points that ANDES has found."""
    where = controls(ss, unit)
    field, power = setpoints(dae)
    machine = ss.models[where["machine"][0]], where["machine"][1]
    given = dict(unit.values)
    given[field] = (
        getattr(ss.models[where["exciter"][0]], SETPOINT[where["exciter"][0]]).v[where["exciter"][1]]
        if "exciter" in where
        else machine[0].vf0.v[machine[1]]
    )
    given[power] = (
        getattr(ss.models[where["governor"][0]], SETPOINT[where["governor"][0]]).v[where["governor"][1]]
        if "governor" in where
        else machine[0].tm0.v[machine[1]]
    )
    return np.array([given[path] for path in dae.p_names], dtype=float)


def voltage(ss: Any, unit: Unit) -> complex:
    k = place(ss, "Bus", unit.bus)
    return complex(ss.Bus.v.v[k] * np.exp(1j * ss.Bus.a.v[k]))


def power(ss: Any, unit: Unit) -> complex:
    """What the unit gives in the power flow."""
    model, k = controls(ss, unit)["machine"]
    machine = ss.models[model]
    return complex(machine.p0s.v[k] * unit.share_p, machine.q0s.v[k] * unit.share_q)


def functions(units: list[Unit]) -> dict[Any, tuple[Dae, ca.Function]]:
    """One compiled system for every structure: f and the outputs of (x, u, p, q)."""
    made = {}
    for unit in units:
        if unit.structure not in made:
            dae = unit.diagram().compile()
            made[unit.structure] = dae, ca.Function("unit", [dae.x, dae.u, dae.p, dae.q], [dae.f, dae.y])
    return made


def start_flags(dae: Dae) -> np.ndarray:
    return np.concatenate([np.zeros(0), *[a.flags[a.mode_number(a.start)] for a in dae.automata]])


__all__ = [
    "CASES", "FURTHER", "controls", "fresh", "functions", "place", "power", "read_units", "start_flags",
    "state", "system", "values", "voltage",
]  # fmt: skip
