"""Facility behind a line-interactive UPS."""

from __future__ import annotations

from dcvrt.facility.ac_side import ac_facility, name_outputs, standby_ups
from dcvrt.models import (
    Cooling,
    Diagram,
    LineConditioner,
    LineInteractiveControl,
    ParallelConverter,
    StandbyLedger,
)


def line_interactive() -> Diagram:
    """Line-interactive UPS: load on the line through a static switch, a bidirectional converter beside it.

    What it is: medium-voltage and industrial UPS without a rectifier in the power path (such as ABB's PCS100
    UPS-I), small units with buck and boost, and, with its conditioner, delta conversion. What for: the most
    efficient protection, bought with a load that leaves the grid at every sag below the window.

    Within the window of 0.90 to 1.10 pu the conditioner holds the bus at its set point and the grid sees
    constant power. Outside it the switch opens at once, the bus is dead for switch.T_transfer (1.8 ms),
    which the servers bridge, and the inverter carries the load from the battery: the import is zero within
    milliseconds, whatever beta is, and the length of the sag does not matter. When the line is healthy the
    inverter turns onto it, qualifies it for 3 s, closes without a gap, walks the load in over 10 s and
    recharges. A sag during that time starts it all again. A swell beyond 1.10 pu does the same; a phase jump
    alone does nothing, the load simply sees it. beta is the rating of the inverter: too small, and the bus
    folds back on battery.

    w_dc is the energy in the capacitors of the server supplies over nominal: the store that decides whether
    the servers outlive the transfer. `mode` is that of the control, `mode_servers` that of the supplies,
    `mode_switch` that of the switch.

    Left out: steps of the taps, the currents of the converter while it forces the switch open, transfer to a
    generator, detection of islanding by frequency. Cooling is behind the UPS, as in `gfl`.
    Sources: manuals of ABB PCS100 UPS-I, Prolink PRO, UFGS 16265 and Mitsubishi 9800A, named at the
    parameters; thresholds are illustrative.

    >>> line_interactive().compile().u_names
    ('v_poi.re', 'v_poi.im', 'g_it')
    """
    control = LineInteractiveControl()
    f = ac_facility("line-interactive", "line-interactive UPS", StandbyLedger(), Cooling())
    standby_ups(f, control)
    conditioner = f.add("conditioner", LineConditioner())
    converter = f.add("converter", ParallelConverter())

    f.set("switch.T_transfer", 1.8e-3, "ABB PCS100 UPS-I: typically 1.8 ms")
    f.connect(f.port("v_poi"), conditioner.v)
    f.connect(f.port("meter.v_f"), conditioner.v_f)
    f.connect(conditioner.v_out, f.port("switch.v_grid"))
    f.connect(f.port("switch.v"), converter.v)
    f.connect(f.port("bus.i"), converter.i)
    f.connect(f.port("switch.on_grid"), converter.on_grid)
    f.connect(control.share, converter.share)
    f.connect(f.port("battery.ask"), converter.ask)
    f.connect(converter.i_line, conditioner.i_out)
    f.connect(conditioner.i, f.port("poi.i"))
    name_outputs(f)
    f.output("mode_servers", f.port("supply.mode"))
    f.output("mode_switch", f.port("switch.mode"))
    return f
