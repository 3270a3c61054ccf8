"""Facility without a UPS: servers straight on the grid."""

from __future__ import annotations

from dcvrt.facility.ac_side import ac_facility, feed, name_outputs
from dcvrt.models import ContactorCooling, Diagram, NoBattery, SupplyLedger

INPUT_RATING = (
    1.28,
    "input current limit of the server supplies over their rated current",
    "Intel SC5650: full load from 180 V of 230 V up",
)


def no_ups() -> Diagram:
    """Servers straight on the grid through their own power supplies, cooling behind contactors.

    What it is: crypto-mining halls, and training halls whose owners take an interruption for cheaper than a
    UPS. What for: the lower end of the scale: what ride-through the servers have by themselves.

    In a sag the supplies draw constant power until their input current limit: beta is that limit over rated
    current, so that servers ride for any time through V > d/beta (0.74). In a deeper sag the difference comes
    from their capacitors, which last T_hold/(d - beta V): 55 ms at 0.6 pu, 32 ms at 0.5 pu, 10.5 ms at 0;
    below supply.V_off all of it does. Then they trip, and come back 25 to 300 s after the voltage has: a
    fault of two cycles at 0.5 pu takes all servers of a region away for minutes. Cooling drops out
    below 0.55 pu and restarts in stages. A swell and a phase jump mean nothing to it: supplies have neither
    a window above nor a PLL. What cannot be carried at rest (V0 < d/beta) is refused as a start.

    There is no battery: p_b and soc are 0. w_dc is the energy in the capacitors of the server supplies, the
    only energy there is. `mode` is that of the supplies; `mode_cooling` that of the contactors.

    Left out: the spread of supplies and phases (all trip at one instant, single-phase sags hit only the
    third of the supplies that hangs on the phase), starting currents of motors, tripping on over-voltage.
    Sources: manuals of Intel server systems, named at the parameters.

    >>> no_ups().compile().u_names
    ('v_poi.re', 'v_poi.im', 'g_it')
    """
    cooling = ContactorCooling()
    f = ac_facility("no-ups", "servers straight on the grid, no UPS", SupplyLedger(), cooling, INPUT_RATING)
    battery = f.add("battery", NoBattery())
    f.bind(f.blocks["supply"], I_lim=f.shared["beta"].symbol)
    f.connect(cooling.demand, f.port("demand.cooling"))
    f.connect(f.port("bus_meter.v_f"), cooling.v)
    f.connect(f.port("bus.i"), f.port("poi.i"))
    feed(f, f.port("v_poi"))
    name_outputs(f, mode=f.port("supply.mode"), p_b=battery.p, soc=battery.soc)
    f.output("mode_cooling", cooling.mode)
    return f
