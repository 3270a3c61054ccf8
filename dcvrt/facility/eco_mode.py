"""Facility behind a double-conversion UPS that runs in eco mode."""

from __future__ import annotations

from dcvrt.facility.ac_side import ac_facility, name_outputs, standby_ups
from dcvrt.models import Cooling, Diagram, EcoModeControl, Rectifier, StandbyLedger


def eco_mode() -> Diagram:
    """Eco-mode UPS: load on the static bypass, transfer to double conversion when the grid is unfit.

    What it is: the same cabinet as `gfl`, run with its converters asleep to save some 2 or 3 % of the energy;
    most vendors offer it under a name of their own. What for: what that saving costs the grid.

    Within 0.90 to 1.10 pu it is a wire, plus what the battery charges. At the first excursion the bypass is
    turned off and within 2 ms the inverter carries the load from the battery: the import is zero, although
    the same UPS in double conversion would have gone on importing. Once the input has been usable (0.80 to
    1.12 pu) for 3 s the rectifier walks the load in over 10 s; then double conversion holds for 5 minutes of
    healthy input before the load goes back to the bypass without a gap. During that time a sag is met by the
    rectifier: below 0.78 pu it stops and the battery carries the load again, above it the import goes on,
    limited by the current beta H. A phase jump alone does nothing; the load sees it.

    w_dc is the energy in the capacitors of the server supplies over nominal: the store that decides whether
    the servers outlive the transfer. `mode` is that of the control, `mode_servers` that of the supplies,
    `mode_switch` that of the switch.

    Left out: current loop, PLL and DC link of the rectifier (`gfl` has them), forced commutation of the
    bypass, filters that stay connected, learning of the vendors' detection. The window is illustrative.
    Sources: manuals of Eaton 9395, 91PS and 9PX, Mitsubishi 9800A, Staco FirstLine, named at the parameters.

    >>> eco_mode().compile().u_names
    ('v_poi.re', 'v_poi.im', 'g_it')
    """
    control = EcoModeControl()
    f = ac_facility("eco-mode", "double-conversion UPS in eco mode", StandbyLedger(), Cooling())
    standby_ups(f, control)
    rectifier = f.add("rectifier", Rectifier())
    f.bind(rectifier, H=f.shared["H"].symbol, beta=f.shared["beta"].symbol, pf=f.shared["pf"].symbol)
    f.connect(f.port("v_poi"), f.port("switch.v_grid"), rectifier.v)
    f.connect(f.port("bus.i"), rectifier.i_bus)
    f.connect(f.port("bus.p"), rectifier.p_bus)
    f.connect(f.port("switch.on_grid"), rectifier.on_grid)
    f.connect(f.port("switch.on_inverter"), rectifier.on_inverter)
    f.connect(control.share, rectifier.share)
    f.connect(control.rectify, rectifier.rectify)
    f.connect(f.port("battery.ask"), rectifier.ask)
    f.connect(rectifier.i, f.port("poi.i"))
    name_outputs(f)
    f.output("mode_servers", f.port("supply.mode"))
    f.output("mode_switch", f.port("switch.mode"))
    return f
