"""Searches refuse, in one sentence and before work, each number that has no derivative.

These are the numbers of `test_every_number` by which `jax.grad` refuses derivatives, and those that
move samples, which a search keeps.
"""

import numpy as np
import pytest

import jaxbeam as jb
import tuning
from jaxbeam.case.case import value_at
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.cli import main
from tests.cli.example import CONTROLLED_CASE
from tests.simulation.test_every_number import CASES, JUMPING_NUMBERS

CASE_OF = {address: name for name, address in JUMPING_NUMBERS}
LOADS = tuning.LoadCases(({"loads.0.entry_time": 0.03},))


def log(case: jb.Case) -> tuning.Log:
    """A log of readings of all sensors, of which no fit begins."""
    times, sensors = np.linspace(0.0, 0.4, 80), range(len(case.sensors))
    names = tuple(f"sensor {i}" for i in sensors)
    quantities = tuple(one.quantity for one in case.sensors)
    units = tuple(QUANTITIES[one].unit for one in quantities)
    values = np.ones((times.size, len(names)))
    return tuning.Log(times, values, names, quantities, units, sensors=tuple(sensors))


def bounds(case: jb.Case, address: str) -> tuple[float, float]:
    value = float(value_at(case, address))
    return min(0.5 * value, 2 * value), max(0.5 * value, 2 * value)


SEARCHES = {
    "identify": lambda case, address: tuning.identify(case, log(case), address),
    "tune": lambda case, address: tuning.tune(case, {address: bounds(case, address)}, LOADS),
    "design-experiment": lambda case, address: tuning.design_experiment(
        case, [address], {"loads.0.entry_time": (0.0, 0.1)}
    ),
    "design-experiment over": lambda case, address: tuning.design_experiment(
        case, ["beam.damping_ratio"], {address: bounds(case, address)}
    ),
}


@pytest.mark.parametrize("address", CASE_OF)
def test_searches_refuse_what_has_no_derivative(address):
    case, _ = CASES[CASE_OF[address]]
    if value_at(case, address).ndim:
        address += ".0"
    for search in SEARCHES.values():
        with pytest.raises(ValueError, match=f"^{address} cannot be free: .*compare several") as e:
            search(case, address)
        assert "\n" not in str(e.value)


COMMANDS = {
    "identify": "identify case.toml log.csv --free",
    "tune": "tune case.toml --cases loads.toml --no-least-peaks --free",
    "design-experiment": "design-experiment case.toml --vary loads.0.mass=0.1:2 --free",
    "design-experiment over": "design-experiment case.toml --free loads.0.mass --vary",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_refuse_what_has_no_derivative(command, tmp_path, monkeypatch, capsys):
    address = "sensors.0.resolution"
    case = CONTROLLED_CASE.replace("[[sensors]]", "[[sensors]]\nresolution = 1e-5")
    (tmp_path / "case.toml").write_text(case)
    (tmp_path / "loads.toml").write_text('[training]\n"loads.0.mass" = [0.3, 0.5]\n')
    rows = "".join(f"{0.1 * i:.1f},{i % 3}\n" for i in range(8))
    (tmp_path / "log.csv").write_text(f"t [s],a [mm]\n{rows}")
    monkeypatch.chdir(tmp_path)
    bounds = "" if command in ("identify", "design-experiment") else "=1e-6:1e-4"
    with pytest.raises(SystemExit) as ended:
        main([*COMMANDS[command].split(), f"{address}{bounds}"])
    error = capsys.readouterr().err.strip()
    assert ended.value.code == 1
    assert error.endswith(
        f"{address} cannot be free: what is rounded to it jumps, so that it has"
        " no derivative; compare several of its values"
    )
    assert "\n" not in error
