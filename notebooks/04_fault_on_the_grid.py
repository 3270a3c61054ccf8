# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A fault on the grid, and what a megawatt does to it
#
# The voltage that a data centre sees in a fault comes from the whole transmission system: power flow, machines,
# exciters, governors, the fault and its clearing. The native engine simulates all of it and carries derivatives along,
# so that one run tells the voltage at every site and how it moves with every hosted megawatt.
#
# The network is the IEEE 118-bus case with machines from a rule table. Values are illustrative unless their source says
# otherwise.

# %%
import matplotlib.pyplot as plt
import numpy as np

from dcvrt import Criteria, facility
from dcvrt.grid import BusFault, FaultSequence, Grid, LineTrip, Period
from dcvrt.planning.coupling import compare

SITES = (21, 75, 106, 108)
grid = Grid.from_case("ieee118", sites=SITES, reactive_limits=True)
hosting = {21: 25.0, 75: 80.0, 106: 50.0, 108: 60.0}  # MW
fault = BusFault(107, start=0.5, clear=0.1)

# %% [markdown]
# ## Voltage at the sites
#
# A three-phase fault at bus 107, cleared after 100 ms. The waveform jumps at inception and at clearing, and is smooth
# between: both sides of a jump are kept.

# %%
waveforms = grid.waveforms(hosting, fault, until=2.0, wrt=("H",))
figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
for bus, waveform in waveforms.items():
    axes.plot(waveform.t, np.abs(waveform.v), label=f"bus {bus}")
axes.set(xlabel="time (s)", ylabel="POI voltage (pu)", ylim=(0, 1.05))
axes.legend(ncols=2)
plt.show()

# %% [markdown]
# ## What a megawatt does
#
# `wrt=("H",)` asks for the derivative of every voltage by what each site hosts, through power flow, equilibrium of the
# machines, fault and clearing. Two runs at neighbouring capacities confirm it.


# %%
in_fault = np.flatnonzero(waveforms[108].t < 0.6)[-1]  # the last sample before the fault is cleared


def retained(bus: int, capacities: dict[int, float]) -> float:
    """Voltage at a site just before the fault is cleared, pu."""
    return float(abs(grid.waveforms(capacities, fault, until=2.0)[bus].v[in_fault]))


v, dv = waveforms[108].v[in_fault], waveforms[108].tangents["H_106"][in_fault]
slope = float((np.conj(v) * dv).real / abs(v))
step = 0.5
difference = (retained(108, hosting | {106: 50.0 + step}) - retained(108, hosting | {106: 50.0 - step})) / (2 * step)
print(f"d|V_108|/dH_106 in the fault: {slope:.4e} pu/MW by tangents, {difference:.4e} by differences")
assert abs(slope - difference) < 0.01 * abs(difference)

# %% [markdown]
# ## Other disturbances
#
# A fault may be cleared by opening a branch, lines may trip, and faults may come in sequence, as after an unsuccessful
# reclosing.

# %%
reclosed = FaultSequence((BusFault(107, start=0.5, clear=0.1), BusFault(107, start=1.1, clear=0.1)))
opening = BusFault(107, start=0.5, clear=0.1, opens=(105, 107))
trip = LineTrip(105, 106, start=0.5)
for name, event in {"cleared by 105-107": opening, "line 105-106 trips": trip, "reclosing": reclosed}.items():
    lowest = {bus: float(np.abs(w.v).min()) for bus, w in grid.waveforms(hosting, event, until=2.0).items()}
    print(name, {bus: round(value, 3) for bus, value in lowest.items()})

# %% [markdown]
# ## Does the facility act back?
#
# By default a site is a constant impedance in the fault, as in most screening tools. `compare` puts the dynamic
# facilities into the network and tells by how much their margins move.

# %%
ups = facility.gfl()
ups.set("beta", 1.3)
table = compare(grid, hosting, ups, [fault], Period(), Criteria(), until=2.0)
table[["fault", "site", "v_poi_min_open", "v_poi_min_closed", "loss_open", "loss_closed", "passed_open", "passed_closed"]]

# %%
assert (table["status"] == "").all()
worst = float((table["loss_closed"] - table["loss_open"]).abs().max())
print(f"largest change of a loss margin: {100 * worst:.2f} % of the load")
