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
# # A first block
#
# A facility in dcvrt is a diagram of blocks. A block says what it is, declares its parameters, ports and states by
# name, and gives its equations once. The same lines run on plain numbers, when you try them, and on symbols, when a
# diagram compiles to fast code with derivatives.
#
# We write one from nothing: the cooling water of a data hall. When a fault stops the chillers, the water warms up,
# and the question is how long that may last. One lump of water, one equation:
#
# $$ T \dot\theta = R\,(P^{heat} - P^{cool}) - \theta $$
#
# $\theta$ is the rise above the set point, $P^{heat}$ what the servers give off, $P^{cool}$ what the chillers take.
# Heat minus cooling is held for ever at a rise of $R$ per unit of power; the water's own time is $T$.

# %%
import numpy as np

from dcvrt import Simulator, Waveform
from dcvrt.errors import DcvrtError
from dcvrt.models import Block, Diagram, Equations, Input, Output, Parameter, State


# %% [markdown]
# ## Getting it wrong
#
# dcvrt's messages are written to tell you the next keystroke, so let us make mistakes first. A small helper shows
# what each of them says.

# %%
def told(attempt):
    """Show the message of an attempt that fails."""
    try:
        attempt()
    except DcvrtError as error:
        print(error)
    else:
        raise AssertionError("this was meant to fail")


def plain_per_unit():
    class WaterLoop(Block):
        heat = Input("pu", "heat of the servers")


told(plain_per_unit)


# %% [markdown]
# A voltage and a power are both "per unit", and nothing good comes of mixing them: so the unit says which it is.
# The next attempt forgets an equation and misspells a name.

# %%
class Forgetful(Block):
    """Water that nobody computes."""

    T = Parameter(120.0, "s", (1.0, 3600.0), "time constant")
    heat = Input("pu(S)", "heat of the servers")
    theta = State(0.0, "K", "rise of the water temperature")
    rise = Output("K", "the same, as an output")

    def equations(self, s):
        return Equations(out=dict(rise=s.theta))


class Misspelt(Forgetful):
    """Water whose time constant has another name."""

    def equations(self, s):
        return Equations(der=dict(theta=(s.heat - s.theta) / s.Tau), out=dict(rise=s.theta))


def hall(block):
    """The block alone in a diagram: heat comes from outside."""
    d = Diagram("hall")
    heat = d.input("heat", "pu(S)", rest=0.5, doc="heat of the servers")
    water = d.add("water", block)
    d.connect(heat, water.heat)
    d.output("theta", water.theta)
    return d


told(lambda: hall(Forgetful()).compile())
told(lambda: hall(Misspelt()).compile())
told(lambda: Forgetful(T=0.0))

# %% [markdown]
# Equations run on symbols too, and two things do not work on a symbol: asking whether it is large, and reading the
# parameter from `self`, where it is a number that no later run could change.

# %%
class Choosing(Forgetful):
    """Water that is only warmed."""

    def equations(self, s):
        warming = s.heat if s.heat > 0.0 else 0.0
        return Equations(der=dict(theta=(warming - s.theta) / s.T), out=dict(rise=s.theta))


class Frozen(Forgetful):
    """Water whose time constant is what it was when the equations were written down."""

    def equations(self, s):
        return Equations(der=dict(theta=(s.heat - s.theta) / self.T), out=dict(rise=s.theta))


told(lambda: hall(Choosing()).compile())
told(lambda: hall(Frozen()).compile())

# %% [markdown]
# ## Getting it right
#
# The order is always the same: what it is in one sentence; the equation; what a reader must know to trust it;
# parameters with unit, range, meaning and **source**; ports; states; equations. `rest` is optional. It helps the
# search for the point at which a run starts.

# %%
class WaterLoop(Block):
    r"""Temperature of the cooling water between servers and chillers.

    .. math::
        T \dot\theta = R\,(P^{heat} - P^{cool}) - \theta

    One well-mixed volume. Equilibrium: theta = R (P_heat - P_cool). After a step of the heat:
    :math:`1 - e^{-t/T}` of the way.
    Differs: the paper's cooling has a power but no temperature.
    """

    T = Parameter(120.0, "s", (1.0, 3600.0), "time constant of the water", "illustrative")
    R = Parameter(20.0, "K/pu(S)", (0.1, 500.0), "rise per power that is not cooled away", "illustrative")

    heat = Input("pu(S)", "heat of the servers")
    cooling = Input("pu(S)", "heat that the chillers take")
    rise = Output("K", "rise of the water temperature")

    theta = State(0.0, "K", "rise of the water temperature", (-50.0, 15.0), "servers throttle (above)")

    def equations(self, s):
        rate = (s.R * (s.heat - s.cooling) - s.theta) / s.T
        return Equations(der=dict(theta=rate), out=dict(rise=s.theta))

    def rest(self, s):
        return dict(theta=s.R * (s.heat - s.cooling))


# %% [markdown]
# Try it on numbers, without any diagram. `at` fills in the parameters.

# %%
water = WaterLoop()
print(water.equations(water.at(heat=0.7, cooling=0.5, theta=0.0)))
print("depends at once on:", water.feedthrough())

# %% [markdown]
# ## Its tests
#
# The block that leaves this notebook takes its tests along. The first is a closed form, the only kind that knows what is
# right: after a step the temperature is an exponential. The second is the rest point. The third,
# `assert_consistent`, holds for every block: numbers and symbols agree, and every derivative is that of the equation.

# %%
from dcvrt.models.testing import assert_consistent


def loop(**values):
    d = Diagram("hall")
    heat, cooling = (d.input(name, "pu(S)", rest=0.5) for name in ("heat", "cooling"))
    water = d.add("water", WaterLoop(**values))
    d.connect(heat, water.heat)
    d.connect(cooling, water.cooling)
    d.output("theta", water.rise)
    return d.compile()


def test_a_step_of_the_heat_warms_the_water_exponentially():
    T, R, step = 10.0, 20.0, 0.3
    run = Simulator(loop(T=T, R=R))(
        Waveform.segments([(0.0, 1.0)], until=30.0),
        inputs={"heat": ([0.0, 5.0, 5.0, 30.0], [0.5, 0.5, 0.5 + step, 0.5 + step])},
    )
    expected = R * step * (1 - np.exp(-(run.t - 5.0).clip(0.0) / T))
    assert np.abs(run["theta"] - expected).max() < 1e-5


def test_the_water_rests_where_heat_and_cooling_leave_it():
    at = Simulator(loop(R=20.0)).equilibrium(inputs={"heat": 0.9})
    assert abs(at["theta"] - 20.0 * (0.9 - 0.5)) < 1e-9


def test_the_water_is_consistent():
    assert_consistent(WaterLoop(), ranges={"theta": (-5.0, 15.0)})
    assert WaterLoop().feedthrough() == {"rise": ()}


test_a_step_of_the_heat_warms_the_water_exponentially()
test_the_water_rests_where_heat_and_cooling_leave_it()
test_the_water_is_consistent()
print("passed")

# %% [markdown]
# A check that cannot fail is none. Here is a block whose derivative lies: it branches on a number, which a symbol
# cannot do. The check says where.

# %%
class Lying(WaterLoop):
    """Reads a different value when it is given numbers."""

    def equations(self, s):
        heat = s.heat * 1.01 if isinstance(s.heat, float) else s.heat
        return Equations(der=dict(theta=s.R * heat - s.theta), out=dict(rise=s.theta))


try:
    assert_consistent(Lying())
except AssertionError as found:
    print(found)
else:
    raise AssertionError("the check must see this")

# %% [markdown]
# ## Wiring it
#
# Wires are checked as well: every input needs a source of its unit. The message names what could feed it.

# %%
d = Diagram("hall")
voltage = d.input("v", "pu(V)", doc="voltage")
heat = d.input("heat", "pu(S)", doc="heat of the servers")
water = d.add("water", WaterLoop())
d.connect(voltage, water.cooling)
told(d.compile)

# %% [markdown]
# ## What it is good for
#
# How long may the chillers stand still? The rise has a range of validity, and leaving it ends a run with a sentence.
# The closed form knows the time as well: $-T \ln(1 - \theta_{max}/(R P))$.

# %%
dae = loop(R=40.0)
stopped = {"cooling": ([0.0, 10.0, 10.0, 300.0], [0.5, 0.5, 0.0, 0.0])}
run = Simulator(dae, save_at=1.0).attempt(Waveform.segments([(0.0, 1.0)], until=300.0), inputs=stopped)
print(run.status)
limit = 10.0 - 120.0 * np.log(1 - 15.0 / (40.0 * 0.5))
print(f"closed form: {limit:.3f} s")
assert abs(run.t[-1] - limit) < 1e-3

# %% [markdown]
# The sheet of a diagram shows the block to whoever has to trust it: equations, parameters with their sources, ports.
# The next notebook puts a new block into a facility.

# %%
from IPython.display import Markdown

d = Diagram("hall", "one hall and its cooling water")
water = d.add("water", WaterLoop())
d.connect(d.input("heat", "pu(S)", doc="heat of the servers"), water.heat)
d.connect(d.input("cooling", "pu(S)", doc="heat that the chillers take"), water.cooling)
d.output("theta", water.rise)
Markdown(d.sheet())
