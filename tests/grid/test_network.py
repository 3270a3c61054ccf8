"""Networks: the matrices obey their definitions, and a bad case is refused in one message."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.grid.network import Network

TRIANGLE = """function mpc = triangle
mpc.version = '2';
mpc.baseMVA = 100;
%% bus data, a comment with 1 2 3
mpc.bus = [
  10 3 0  0  0 0 1 1.0 0 138 1 1.1 0.9;
  20 2 50 10 0 5 1 1.0 0 138 1 1.1 0.9; % generator here
  30 1 90 30 1 0 1 1.0 0 138 1 1.1 0.9
  40 4 90 30 0 0 1 1.0 0 138 1 1.1 0.9
];
mpc.gen = [
  10 80 0 100 -100 1.02 100 1 200 10;
  20 60 0 50 -50 1.01 100 1 120 0;
  20 30 0 50 -50 1.01 100 1 60 0;
  20 30 0 50 -50 1.01 100 0 60 0;
];
mpc.branch = [
  10 20 0.01 0.1 0.02 100 0 0 0    0 1;
  20 30 0.02 0.2 0.04 0   0 0 0.98 5 1;
  10 30 0.01 0.1 0.02 80  0 0 0    0 1;
  10 30 0.01 0.1 0.02 80  0 0 0    0 0;
  10 40 0.01 0.1 0.02 80  0 0 0    0 1;
];
"""


@pytest.fixture
def triangle(tmp_path: Path) -> Network:
    path = tmp_path / "triangle.m"
    path.write_text(TRIANGLE)
    return Network.from_matpower(path)


@pytest.fixture(scope="module")
def ieee118() -> Network:
    return Network.ieee118()


def test_matpower_case_is_read_with_what_is_in_service(triangle: Network) -> None:
    assert triangle.bus.tolist() == [10, 20, 30]
    assert triangle.kind == ("slack", "pv", "pq")
    assert triangle.generators.name == ("G10", "G20", "G20_2")
    assert triangle.branches.rating.tolist() == [100.0, np.inf, 80.0]
    assert triangle.branches.tap.tolist() == [1.0, 0.98, 1.0]
    assert triangle.branches.shift[1] == pytest.approx(np.deg2rad(5))
    assert triangle.v_set.tolist() == [1.02, 1.01, 1.0]
    assert triangle.index(30) == 2


def test_ieee118_is_the_case_that_the_study_documents(ieee118: Network) -> None:
    assert ieee118.generators.p_max.sum() == pytest.approx(9966.2)
    assert ieee118.p_load.sum() == 4242.0
    assert not ieee118.generators.p_min.any()
    assert (ieee118.branches.rating.min(), ieee118.branches.rating.max()) == (72.0, 7218.0)
    assert ieee118.kind.count("pq") == 64
    assert ieee118.bus[ieee118.slack] == 69


def test_admittance_gives_the_branch_currents_of_a_pi_section(triangle: Network) -> None:
    v = np.array([1.02, 1.01 * np.exp(-0.05j), 0.97 * np.exp(-0.1j)])
    current = np.zeros(3, dtype=complex)
    lines = triangle.branches
    for k in range(3):
        f, t = triangle.from_index[k], triangle.to_index[k]
        inner = v[f] / (lines.tap[k] * np.exp(1j * lines.shift[k]))  # behind the ideal transformer
        through = (inner - v[t]) / (lines.r[k] + 1j * lines.x[k])
        into = through + 0.5j * lines.b[k] * inner
        current[f] += into / (lines.tap[k] * np.exp(-1j * lines.shift[k]))
        current[t] += 0.5j * lines.b[k] * v[t] - through
    current += (triangle.g_shunt + 1j * triangle.b_shunt) / 100 * v
    assert triangle.admittance() @ v == pytest.approx(current, abs=1e-13)


def test_dc_flows_balance_every_bus_and_follow_one_set_of_angles(triangle: Network) -> None:
    injection = np.array([0.0, 40.0, -90.0])
    flow = triangle.flows(injection)
    served = triangle.incidence.T @ flow
    assert served[1:] == pytest.approx(injection[1:])  # the slack takes the rest
    drop = flow / triangle.susceptance + triangle.branches.shift
    assert drop[0] + drop[1] == pytest.approx(drop[2])  # angles around the loop 10-20-30-10


def test_ptdf_reproduces_an_angle_solution(ieee118: Network) -> None:
    rng = np.random.default_rng(1)
    injection = rng.normal(size=118) * 50
    laplacian = (ieee118.incidence.T.multiply(ieee118.susceptance) @ ieee118.incidence).toarray()
    keep = np.delete(np.arange(118), ieee118.slack)
    theta = np.zeros(118)
    theta[keep] = np.linalg.solve(laplacian[np.ix_(keep, keep)], injection[keep])
    assert ieee118.flows(injection) == pytest.approx(
        ieee118.susceptance * (ieee118.incidence @ theta), abs=1e-8
    )
    assert not ieee118.ptdf()[:, ieee118.slack].any()


def test_arrays_cannot_be_changed_behind_the_derived_matrices(ieee118: Network) -> None:
    with pytest.raises(ValueError, match="read-only"):
        ieee118.branches.rating[0] = 1.0


def test_unknown_bus_is_named_with_the_nearest(triangle: Network) -> None:
    with pytest.raises(InputError) as error:
        triangle.index(300)
    assert str(error.value) == "triangle has no bus 300. Did you mean '30'? Known: 10, 20, 30."


def test_all_unknown_buses_are_named_at_once(triangle: Network) -> None:
    with pytest.raises(InputError) as error:
        triangle.indices([10, 300, 7])
    assert str(error.value) == (
        "triangle: 2 problems\n  no bus 300. Did you mean '30'? Known: 10, 20, 30.\n"
        "  no bus 7. Known: 10, 20, 30."
    )


def test_faults_of_a_case_are_listed_together(triangle: Network) -> None:
    lines = triangle.branches
    with pytest.raises(InputError) as error:
        replace(
            triangle,
            kind=("pv", "pv", "pq"),
            p_load=np.array([0.0, np.nan, 90.0]),
            branches=replace(lines, to_bus=np.array([20, 30, 99]), x=np.array([0.0, 0.2, 0.1])),
        )
    assert str(error.value) == (
        "triangle: 4 problems\n"
        "  needs exactly one slack bus (type 3), found none.\n"
        "  bus column 'p_load' has NaN in row 1.\n"
        "  branch 10-20 has zero reactance. Way out: merge its buses or give it 1e-4 pu.\n"
        "  branch 10-99 ends at bus 99, which is not in the bus table."
    )


def test_island_is_refused(triangle: Network) -> None:
    with pytest.raises(InputError) as error:
        replace(
            triangle,
            branches=replace(
                triangle.branches, from_bus=np.array([10, 10, 10]), to_bus=np.array([20, 20, 20])
            ),
        )
    assert str(error.value) == (
        "triangle: 1 bus(es) have no path to the slack bus: 30. "
        "Way out: close a branch to them or leave them out."
    )


def test_missing_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "none.m"
    with pytest.raises(InputError) as error:
        Network.from_matpower(path)
    assert str(error.value) == f"{path}: no such file. Way out: give the path of a MATPOWER case (.m)."


def test_unreadable_tables_are_listed_with_their_lines(tmp_path: Path) -> None:
    path = tmp_path / "bad.m"
    path.write_text(
        "mpc.version = '2';\nmpc.baseMVA = 100;\nmpc.bus = [\n 1 3 x 0;\n];\nmpc.gen = [\n 1 2 3;\n];\n"
    )
    with pytest.raises(InputError) as error:
        Network.from_matpower(path)
    assert str(error.value) == (
        f"{path}: 3 problems\n"
        "  line 4: mpc.bus has a word that is not a number: '1 3 x 0'.\n"
        "  line 7: mpc.gen has 3 columns, expected at least 10.\n"
        "  has no table mpc.branch."
    )
