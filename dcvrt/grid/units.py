"""Interim."""
from __future__ import annotations
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Mapping
from dcvrt.models import machines as M

@dataclass(frozen=True, eq=False)
class Unit:
    name: str
    bus: int
    share_p: float
    share_q: float
    machine: Any
    exciter: Any
    governor: Any

    def diagram(self):
        cls=lambda b: None if b is None else type(b)(**b.values)
        return M.unit(cls(self.machine), cls(self.exciter), cls(self.governor))
    @cached_property
    def structure(self): return M.structure(self.diagram())
    @cached_property
    def values(self):
        return {f"{n}.{k}": v for n,b in (("machine",self.machine),("exciter",self.exciter),("governor",self.governor)) if b is not None for k,v in b.values.items()}

def unsupported(system): return []
def read_units(ss):
    G,E,T=ss.GENROU,ss.SEXS,ss.TGOV1
    gov={s:k for k,s in enumerate(T.syn.v)}; exc={s:k for k,s in enumerate(E.syn.v)}
    out=[]
    for k,idx in enumerate(G.idx.v):
        g=lambda n: float(getattr(G,n).v[k])
        A,B=M.quadratic(1.0,g('S10'),1.2,g('S12'))
        names=dict(D='D',M='M',r_a='ra',x_l='xl',x_d='xd',x_q='xq',x_d1='xd1',x_q1='xq1',x_d2='xd2',x_q2='xq2',T_d1='Td10',T_q1='Tq10',T_d2='Td20',T_q2='Tq20')
        have=M.GenRou().values
        vals={}
        for a,b in names.items():
            if a in have: vals[a]=g(b)
            else: print('no',a,list(have)); raise SystemExit
        vals|={n:v for n,v in (('S_A',A),('S_B',B)) if n in have}
        m=M.GenRou(**vals)
        e=exc[idx]; x=M.Sexs(T_A=E.TATB.v[e]*E.TB.v[e],T_B=E.TB.v[e],K=E.K.v[e],T_E=E.TE.v[e],E_min=E.EMIN.v[e],E_max=E.EMAX.v[e])
        gv=None
        if idx in gov:
            j=gov[idx]; gv=M.Tgov1(**{n:float(getattr(T,b).v[j]) for n,b in dict(R='R',T_1='T1',T_2='T2',T_3='T3',V_max='VMAX',V_min='VMIN',D_t='Dt').items()})
        out.append(Unit(f"GENROU '{idx}'",int(G.bus.v[k]),1.0,1.0,m,x,gv))
    return out
