"""What facilities have in common whose servers meet the grid's own AC voltage, by a switch or without."""

from __future__ import annotations

from dcvrt.facility.site import CONVERTER_RATING, give_names, site
from dcvrt.models import (
    AcBus,
    AcLoad,
    Cooling,
    Diagram,
    EcoModeControl,
    FacilityLoad,
    HoldUpSupply,
    LineInteractiveControl,
    Poi,
    StaticSwitch,
    SupplyLedger,
    UpsBattery,
    UpsInverter,
    VoltageFilter,
    WalkIn,
)
from dcvrt.models.block import Port


def ac_facility(
    name: str,
    doc: str,
    ledger: SupplyLedger,
    cooling: Cooling,
    rating: tuple[float, str, str] = CONVERTER_RATING,
) -> Diagram:
    """Loads on an AC bus, POI and ledger; `feed` then says what the bus hangs on.

    `rating` is value, meaning and source of the parameter beta.
    """
    f = site(name, doc, cooling, rating)
    H, beta, pf, pue = (f.shared[k].symbol for k in ("H", "beta", "pf", "PUE"))
    demand = f.add("demand", FacilityLoad())
    meter = f.add("bus_meter", VoltageFilter())
    supply = f.add("supply", HoldUpSupply())
    others = f.add("others", AcLoad())
    bus = f.add("bus", AcBus())
    load = f.add("load", FacilityLoad())
    poi = f.add("poi", Poi())
    f.add("ledger", ledger)

    f.set("bus_meter.T", 2e-3, "illustrative: a server supply tells a lost input within a few ms")
    f.bind(supply, H=H, share=1 / pue, pf=pf)
    f.bind(others, pf=pf)
    f.bind(bus, H=H, beta=beta)

    f.connect(f.port("it.p"), supply.demand, demand.it_demand, demand.it, load.it_demand)
    f.connect(cooling.p, others.cooling_demand)
    f.connect(f.port("aux.p"), others.auxiliary_demand, demand.auxiliary)
    f.connect(meter.v_f, supply.v_f)
    f.connect(supply.i, bus.servers)
    f.connect(others.i, bus.others)
    f.connect(supply.p, load.it)
    f.connect(others.cooling, load.cooling)
    f.connect(others.auxiliary, load.auxiliary)
    f.connect(f.port("v_poi"), poi.v)
    f.connect(supply.energy, ledger.supply_energy)
    return f


def feed(f: Diagram, v_bus: Port) -> None:
    """Hang the bus of the loads on a voltage."""
    f.connect(v_bus, *(f.port(f"{block}.v") for block in ("bus_meter", "supply", "others", "bus")))


def standby_ups(f: Diagram, control: LineInteractiveControl | EcoModeControl) -> None:
    """Switch, inverter, battery and walk-in of a UPS that leaves the load on the grid while it is fit."""
    H, beta = f.shared["H"].symbol, f.shared["beta"].symbol
    meter = f.add("meter", VoltageFilter())
    f.add("control", control)
    walk = f.add("walk", WalkIn())
    switch = f.add("switch", StaticSwitch())
    inverter = f.add("inverter", UpsInverter())
    battery = f.add("battery", UpsBattery())

    f.set("meter.T", 5e-4, "illustrative: the waveform is compared sample by sample")
    f.bind(inverter, H=H, beta=beta)
    f.bind(battery, H=H)

    f.connect(f.port("v_poi"), meter.v, inverter.v_grid)
    f.connect(meter.v_f, control.v_f)
    f.connect(inverter.error, control.error)
    f.connect(battery.soc, control.soc)
    f.connect(control.walk, walk.command)
    f.connect(walk.share, control.walked)
    f.connect(walk.done, control.done)
    f.connect(control.transfer, switch.transfer)
    f.connect(control.charge, battery.charge)
    f.connect(control.align, inverter.align)
    f.connect(control.on, inverter.on)
    f.connect(switch.on_inverter, inverter.on_inverter)
    f.connect(inverter.v, switch.v_inverter)
    f.connect(f.port("bus.i"), inverter.i)
    f.connect(f.port("bus.p"), battery.p_load)
    f.connect(f.port("poi.p"), battery.p_g)
    f.connect(battery.energy, f.port("ledger.battery_energy"))
    f.connect(battery.loss, f.port("ledger.battery_loss"))
    f.connect(f.port("cooling.p"), f.port("demand.cooling"))
    feed(f, switch.v)


def name_outputs(f: Diagram, **others: Port) -> None:
    """Give the outputs that every variant has their names."""
    usual = {
        "v_it": "supply.v_it", "p_g": "poi.p", "q_g": "poi.q", "i_g": "poi.i_mag", "i_max": "bus.i_max",
        "p_b": "battery.p", "soc": "battery.soc", "w_dc": "supply.e",
        "p_load": "demand.demand", "p_out": "load.p", "p_it": "supply.p", "p_cool": "others.cooling",
        "mode": "control.mode", "stored": "ledger.stored", "p_loss": "ledger.loss",
        "i": "poi.drawn",
    }  # fmt: skip
    give_names(f, usual, others)
