"""Identification: true values are recovered within intervals; others are called unidentifiable."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.stats

import jaxbeam as jb
import tuning
from jaxbeam.case.case import replace, value_at
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.cli import main
from tests.cli.example import CONTROLLED_CASE
from tests.oracles import finite_elements, modal_equations
from tests.oracles.crossing import Load
from tests.simulation.test_every_number import CASES, JUMPING_NUMBERS
from tests.tuning.finite_element_rigs import (
    SAGGING,
    SHAKER,
    YIELDING,
    SimulatedIdentification,
    autocorrelated,
    patch,
    plant,
)
from tuning import Fit, Log, identify
from tuning.fit.dataset import make_dataset
from tuning.parameters import to_unbounded

SPAN = modal_equations.Span(0.6, 11.68, 0.535, modes=3, damping_ratio=0.03)
RATE = 500.0


def one_span(sensors=(0.15, 0.3), **run) -> jb.Case:
    """The rig of `SPAN` with its load, as a case."""
    return jb.Case(
        beam=jb.Beam(
            length=SPAN.length,
            flexural_rigidity=SPAN.flexural_rigidity,
            mass_per_length=SPAN.mass_per_length,
            damping_ratio=SPAN.damping_ratio,
            modes=SPAN.modes,
        ),
        sensors=[jb.Sensor(position=position) for position in sensors],
        loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.05)],
        run=jb.Run(duration=run.get("duration", 0.8), sample_rate=run.get("rate", RATE)),
    )


def small(sensors=(0.2,), **run) -> jb.Case:
    """The rig with two modes only."""
    case = one_span(sensors, **run)
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=2))


def log_of(times, values, **about) -> Log:
    """A log of deflections in m."""
    names = tuple(f"w{i}" for i in range(values.shape[1]))
    return Log(
        np.asarray(times), np.asarray(values), names, ("deflection",) * len(names),
        ("m",) * len(names), **about,
    )  # fmt: skip


def simulated_log(case: jb.Case, noise=1e-5, seed=0, **about) -> Log:
    """Readings simulated by jaxbeam, with white noise (m)."""
    record = jb.simulate(case)
    values = np.asarray(record.measured)
    return log_of(
        record.times,
        values + noise * np.random.default_rng(seed).normal(size=values.shape),
        **about,
    )


def oracle_log(load: Load, offsets, noise=1e-5, duration=0.8, seed=1, **about) -> Log:
    """Readings by modal equations, written and integrated independently of jaxbeam."""
    times = np.arange(round(duration * RATE) + 1) / RATE
    clean = modal_equations.respond(SPAN, [load], (0.15, 0.3), times).deflection + offsets
    values = clean + noise * np.random.default_rng(seed).normal(size=clean.shape)
    return log_of(times, values, **about)


def deviations(fit: Fit, truth: dict[str, float]) -> np.ndarray:
    """Errors of the fit in its own standard errors."""
    return (fit.values - [truth[address] for address in fit.addresses]) / fit.errors


TRUTH = {
    "beam.flexural_rigidity": 11.68,
    "beam.mass_per_length": 0.535,
    "beam.damping_ratio": 0.03,
    "sensors.0.offset": 2e-4,
    "sensors.1.offset": -1e-4,
    "logs.0.loads.0.speed": 2.0,
    "logs.0.loads.0.entry_time": 0.05,
    "logs.1.loads.0.speed": -3.1,
    "logs.1.loads.0.entry_time": 0.11,
}


@pytest.fixture(scope="module")
def two_logs() -> Fit:
    """Two crossings of the oracle's beam, one each way, fitted from wrong starts."""
    loads = [Load(0.5, 2.0, 0.05), Load(0.3, -3.1, 0.11)]
    guesses = [
        jb.MovingMass(mass=0.5, speed=2.1, entry_time=0.04),
        jb.MovingMass(mass=0.3, speed=-3.0, entry_time=0.1),
    ]
    logs = [
        oracle_log(load, [2e-4, -1e-4], duration=end, seed=i, source=f"run {i}", loads=(guess,))
        for i, (load, guess, end) in enumerate(zip(loads, guesses, (0.8, 0.7), strict=True))
    ]
    start = {
        "beam.flexural_rigidity": 10.0,
        "beam.mass_per_length": 0.6,
        "beam.damping_ratio": 0.01,
    }
    free = dict.fromkeys(TRUTH) | {"beam.damping_ratio": (0.0, 0.2)}
    return identify(replace(one_span(), start), logs, free)


def test_true_values_are_recovered(two_logs):
    assert two_logs.addresses == list(TRUTH)
    assert np.all(np.abs(deviations(two_logs, TRUTH)) < 3)
    np.testing.assert_allclose(two_logs.noise, 1e-5, rtol=0.1)
    errors = dict(zip(two_logs.addresses, two_logs.errors, strict=True))
    assert errors["beam.flexural_rigidity"] < 0.01 * 11.68
    assert errors["beam.damping_ratio"] < 0.1 * 0.03
    assert two_logs.search == "converged"
    assert not two_logs.at_bound and not two_logs.unidentifiable


def test_fitted_cases(two_logs):
    value = dict(zip(two_logs.addresses, two_logs.values, strict=True))
    assert float(two_logs.case.beam.flexural_rigidity) == value["beam.flexural_rigidity"]
    assert float(two_logs.case.loads[0].speed) == 2.0  # of the case, not used by any log
    assert float(two_logs.cases[1].loads[0].speed) == value["logs.1.loads.0.speed"]
    assert float(two_logs.case.run.duration) == 0.8


def test_correlation(two_logs):
    correlation = two_logs.correlation
    np.testing.assert_allclose(np.diag(correlation), 1, rtol=1e-12)
    np.testing.assert_allclose(correlation, correlation.T, rtol=1e-12)
    i, j = (two_logs.addresses.index(f"logs.0.loads.0.{a}") for a in ("speed", "entry_time"))
    assert correlation[i, j] > 0.5  # later and faster: the same time at midspan


def test_summary_and_figure(two_logs):
    summary = str(two_logs)
    first = summary.splitlines()[3]
    assert first.split()[:4] == ["beam.flexural_rigidity", "N", "m^2", "10"]
    assert "standard deviation of the residual of run 1: " in summary
    plain = json.loads(json.dumps(two_logs.to_dict()))
    assert plain["numbers"]["sensors.0.offset"]["unit"] == "m"
    low, high = plain["numbers"]["logs.1.loads.0.speed"]["interval_95"]
    assert low < -3.1 < high
    figure = two_logs.plot()
    assert {"run 0", "run 1"} <= {axes.get_title("left") for axes in figure.axes}


NOISE = 2e-5


def test_damping_is_not_identifiable_from_a_log_that_ends_at_the_exit():
    """At 0.5 m/s the deflection is quasi-static: it depends on rigidity, hardly on damping."""
    case = replace(small(duration=1.26), {"loads.0.speed": 0.5})
    log = simulated_log(case, 1e-4)
    free = ["beam.flexural_rigidity", "beam.mass_per_length", "beam.damping_ratio"]
    fit = identify(case, log, free)
    assert np.all(np.abs(fit.values[:2] - [11.68, 0.535]) < 3 * fit.errors[:2])
    assert fit.errors[0] < 0.005 * 11.68
    assert fit.errors[1] > 0.05 * 0.535
    assert fit.errors[2] == np.inf
    assert fit.unidentifiable == [{"beam.damping_ratio": pytest.approx(0.003)}]
    assert "beam.damping_ratio is not identifiable from the data: give it a value" in str(fit)


def test_bounds_hold_and_are_reported_when_reached():
    case = replace(small(duration=0.6), {"beam.flexural_rigidity": 9.0})
    log = simulated_log(small(duration=0.6), NOISE)
    fit = identify(case, log, {"beam.flexural_rigidity": (8.0, 11.0), "beam.damping_ratio": None})
    assert fit.at_bound == ["beam.flexural_rigidity"]
    assert 8.0 <= fit.values[0] <= 11.0 and fit.intervals[0, 1] == 11.0
    assert "beam.flexural_rigidity ended at its bound (8 to 11)" in str(fit)
    assert fit.to_dict()["numbers"]["beam.flexural_rigidity"]["at_bound"]


def test_implausible_ends_of_a_search_are_told():
    """Nothing but noise: the search may end anywhere, as at 2.8 times critical damping."""
    case = small()
    dataset = make_dataset(case, [simulated_log(case)])
    assert dataset.validity_warning({"beam.damping_ratio": 0.05}) == ""
    said = dataset.validity_warning({"beam.damping_ratio": 2.8})
    assert said.startswith(", but to values that can hardly be meant: beam.damping_ratio: the")
    already = make_dataset(replace(case, {"beam.damping_ratio": 0.4}), [simulated_log(case)])
    assert already.validity_warning({"beam.damping_ratio": 0.41}) == ""


def test_stiffness_of_an_elastic_support():
    """From a log simulated by jaxbeam; finite elements are used in test_recovery."""
    case = dataclasses.replace(
        small(sensors=(0.15, 0.45), duration=0.6),
        supports=(jb.Support(position=0.3, stiffness=4e4, damping=2.0),),
    )
    log = simulated_log(case, 1e-6)
    start = {"supports.0.stiffness": 3e4, "beam.flexural_rigidity": 12.5}
    fit = identify(replace(case, start), log, list(start))
    truth = {"supports.0.stiffness": 4e4, "beam.flexural_rigidity": 11.68}
    assert np.all(np.abs(deviations(fit, truth)) < 3)
    assert np.all(fit.errors < 0.01 * fit.values)


# Faulty input is refused before anything is compiled.
TIMES = np.arange(400) / RATE
FLAT = np.zeros((400, 2))


def faulty(quantities=("deflection", "deflection"), **about) -> Log:
    given = {"times": TIMES, "values": FLAT, "source": "run.csv"} | about
    count = given["values"].shape[1]
    units = tuple("g" if quantity == "acceleration" else "m" for quantity in quantities)
    names = ("w", "v", "u")[:count]
    return Log(names=names, quantities=quantities[:count], units=units[:count], **given)


LATE = (jb.MovingMass(mass=0.5, speed=1.0, entry_time=0.9),)
FORCE = (jb.MovingForce(force=5.0, speed=2.0),)
SLOW = (jb.MovingMass(mass=0.5, speed=0.5),)
FAULTS = {
    "no logs": ([], "give at least one log"),
    "too few samples": (
        faulty(times=TIMES[:2], values=FLAT[:2]), "run.csv: a fit needs at least 3 samples, not 2"
    ),
    "before zero": (faulty(times=TIMES - 0.1), "run.csv: it starts at -0.1 s, but runs start at 0"),
    "hours late": (faulty(times=TIMES + 3600), "run.csv: it starts only at 3600 s, while runs"),
    "channels missing": (
        faulty(values=FLAT[:, :1]),
        "run.csv: its channels w do not match the case's 2 sensors; say in the TOML file beside",
    ),
    "same sensor twice": (faulty(sensors=(1, 1)), "run.csv: two of its channels are of the same"),
    "unknown sensor": (faulty(sensors=(0, 7)), "do not match the case's 2 sensors"),
    "other quantity": (
        faulty(("acceleration", "deflection")),
        "run.csv: w holds acceleration in g, but sensors.0 measures deflection",
    ),
    "ends before entry": (
        faulty(loads=LATE),
        "run.csv: it ends at 0.798 s, before the first load enters at 0.9 s",
    ),
    "shorter than a crossing": (
        faulty(loads=SLOW),
        "run.csv: it ends at 0.798 s, before the first load has crossed at 1.2 s; check the load's "
        "speed and entry time",
    ),
    "no loads": (faulty(loads=()), "run.csv: no load is known, neither in the case nor in"),
    "nothing measured": (faulty(values=0 * FLAT), "all readings of the logs are 0: there is"),
    "unlike loads": ([faulty(), faulty(loads=FORCE)], "the logs differ in the kinds of their"),
}  # fmt: skip


@pytest.mark.parametrize("logs, words", FAULTS.values(), ids=FAULTS)
def test_faulty_logs_are_refused(logs, words):
    with pytest.raises(ValueError) as refused:
        identify(one_span(), logs, ["beam.length"])
    assert words in str(refused.value)


def test_case_without_sensors_is_refused():
    with pytest.raises(ValueError, match="the case has no sensors to compare the logs with"):
        identify(one_span(sensors=()), faulty(), ["beam.length"])


def test_free_may_be_a_single_address():
    with pytest.raises(ValueError, match="did you mean 'beam.flexural_rigidity'"):
        identify(one_span(), faulty(), "beam.flexural_rigidty")


# Searches refuse, in one sentence and before work, each number that has no derivative.
#
# These are the numbers of `test_every_number` by which `jax.grad` refuses derivatives, and those
# that move samples, which a search keeps.

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


# Parameters of finite-element rigs recovered under autocorrelated noise by models of fewer modes.
#
# They are fitted one by one, the others known, and all together; a wrong model is called
# unreliable.

THREE_ERRORS = 3 / 1.96  # half widths of an interval in three standard errors
SMALLEST_COUNT = 4  # parameters of the smallest rig

PLANTS = {
    "one span, shaker": plant(
        1,
        11.68,
        0.535,
        [jb.Shaker(**SHAKER)],
        [finite_elements.Suspension(*list(SHAKER.values())[:3])],
        {0.0: YIELDING, 0.6: YIELDING},
        [(0.15,), (0.35,)],
        modes=6,
    ),
    "one span, patch": plant(
        1,
        13.211,
        0.812,
        [patch(0.2575, 0.32)],
        [],
        {0.0: YIELDING, 0.6: YIELDING},
        [(0.2,), (0.3,)],
        modes=6,
    ),
    "two spans, patches": plant(
        2,
        12.277,
        0.7924,
        [patch(0.2575, 0.39), patch(0.8575, 0.68)],
        [],
        {0.6: SAGGING},
        [(0.3,), (0.9,)],
        modes=8,
    ),
}


@pytest.fixture(scope="module", params=PLANTS)
def identification(request) -> SimulatedIdentification:
    return SimulatedIdentification(PLANTS[request.param])


def test_all_parameters_together_lie_within_their_intervals(identification):
    """None is off by more than three standard errors; together, by the 99.9 % quantile."""
    free = np.ones(len(identification.truth), bool)
    solution = identification.fit(autocorrelated(identification.clean.shape, seed=0), free)
    assert solution.converged
    errors = identification.errors(solution, free)
    errors_by_address = dict(zip(identification.truth, errors, strict=True))
    assert np.all(np.abs(errors) < THREE_ERRORS), errors_by_address
    distance = errors @ np.linalg.solve(solution.uncertainty.correlation, errors) * 1.96**2
    assert distance < scipy.stats.chi2.ppf(0.999, errors.size), errors_by_address


def test_each_parameter_alone_lies_within_its_interval(identification):
    """Parameters of the beam, which all rigs have, on the rig with one patch only."""
    names = list(identification.truth)
    own = ("actuators", "supports")
    addresses = [n for n in names if n.startswith(own) or len(names) == SMALLEST_COUNT]
    for seed, name in enumerate(addresses):
        free = np.array([n == name for n in names])
        solution = identification.fit(autocorrelated(identification.clean.shape, seed + 1), free)
        assert solution.converged
        (error,) = identification.errors(solution, free)
        assert abs(error) < THREE_ERRORS, (name, error)


@pytest.mark.parametrize("identification", ["one span, patch"], indirect=True)
def test_intervals_of_a_wrong_model_are_called_unreliable(identification):
    """A rigidity fixed 10 % too high biases the other parameters; the fit warns of it."""
    noise = np.random.default_rng(0).normal(size=identification.clean.shape)
    free = np.array([name != "beam.flexural_rigidity" for name in identification.truth])
    right = identification.fit(noise, free)
    assert np.all(np.abs(identification.errors(right, free)) < THREE_ERRORS)
    assert right.converged and "unreliable" not in str(identification.result(noise, right))
    stiffer = to_unbounded(
        identification.parameters, [1.1 * x for x in identification.truth.values()]
    )
    wrong = identification.fit(noise, free, stiffer)
    assert np.any(np.abs(identification.errors(wrong, free)) > THREE_ERRORS)
    assert "unreliable" in str(identification.result(noise, wrong))
