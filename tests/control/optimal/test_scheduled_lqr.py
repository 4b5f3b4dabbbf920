"""Gains scheduled over mass and speed, and loads recognised while they come."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check
from jaxbeam.control import FiniteLQR, ScheduledLQR
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.modes import lay_out
from jaxbeam.model.statics import influence_line, static_lift
from jaxbeam.numerics.gain_table import GainTable

WEIGHTS = {
    "state_weight": [1e3, 1e2, 0.1, 0.01, 0.0],
    "command_weight": [9e-5],
    "coordinates": "sine",
    "points": 210,
}
GRID = {"masses": [0.2, 0.4], "speeds": [1.0, 2.0]}
RECOGNITION = jb.Recognition(gates=[-0.15, -0.05], until=0.3)


def rig(controller=None, mass=0.4, speed=1.0, **run):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.Shaker(0.25, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)],
        sensors=[jb.Sensor(0.2), jb.Sensor(0.3, quantity="velocity"), jb.Sensor(0.45)],
        loads=[jb.MovingMass(mass=mass, speed=speed, entry_time=0.2)],
        controller=controller,
        run=jb.Run(**({"duration": 0.9, "sample_rate": 250.0} | run)),
    )


@eqx.filter_jit
def _commands(case, layout, states, times):
    model = jb.state_space(case, layout=layout)
    memory = case.controller.init(model)

    def one(state, t):
        seen = Measurement(jnp.zeros(3), state, jnp.zeros(1))
        return case.controller.step(memory, seen, t)[0]

    return jax.vmap(one)(states, times)


STATES = jnp.asarray(np.random.default_rng(0).normal(size=(3, 5)) * [1e-3, 1e-4, 0.03, 0.01, 0.2])


def commands(controller, shares, mass=0.4, speed=1.0):
    """Commands to some states at shares of the crossing."""
    case = rig(controller, mass, speed)
    times = 0.2 + 0.6 / abs(speed) * jnp.asarray(shares)
    return np.asarray(_commands(case, lay_out(case), STATES, times)[:, 0])


@pytest.mark.slow
def test_schedules_are_the_designs_they_are_made_of():
    """On the grid those of a single design; between them the mean; outside the nearest, stretched.

    From the end on the last gain fades.
    """
    shares = [0.1, 0.6, 1.0 + 0.05 / 0.6]
    end = {"terminal_weight": [1e3, 1e2, 0.1, 0.01, 1e-3]}
    family = ScheduledLQR(**WEIGHTS, **GRID, **end, after="fade", fade_time=0.05)
    single = FiniteLQR(**WEIGHTS, **end, after="hold")
    known = {
        (m, v): commands(single, shares, m, v) * [1.0, 1.0, np.exp(-1.0 / v)]
        for m in GRID["masses"]
        for v in GRID["speeds"]
    }
    for at, expected in known.items():
        assert_allclose(commands(family, shares, *at), expected, rtol=1e-9)
    mean = sum(known.values()) / 4
    # At another speed the same share is at another time, so the fading is left out.
    assert_allclose(commands(family, shares, 0.3, 1.5)[:2], mean[:2], rtol=1e-9)
    assert_allclose(commands(family, shares, 0.5, 3.0)[:2], known[0.4, 2.0][:2], rtol=1e-9)
    nearest = dataclasses.replace(family, between="nearest")
    assert_allclose(commands(nearest, shares, 0.26, 1.6)[:2], known[0.2, 2.0][:2], rtol=1e-9)


@pytest.mark.parametrize(("fade", "left"), [(None, 1.0), (0.5, np.exp(-2.0))])
def test_what_is_left_after_the_exit(fade, left):
    fade = None if fade is None else jnp.asarray(fade)
    table = GainTable(jnp.array([0.0, 1.0]), jnp.ones((1, 4, 1, 1)))
    at = jnp.asarray
    schedule = GainSchedule(table, 3 * jnp.ones((1, 1)), jnp.zeros(0), at(1.0), at(2.0), fade)
    assert schedule.gain(at(0.5)) == 0.0
    assert schedule.gain(at(1.5)) == 1 + 0.5 + 0.25 + 0.125
    assert_allclose(schedule.gain(at(3.0)), 3 * left, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.8, -0.8])
def test_a_load_is_recognised_in_the_loop(speed):
    """No command before the second gate; then the schedule of the load, to a few percent."""
    gates = RECOGNITION.gates if speed > 0 else 0.6 - RECOGNITION.gates
    recognition = dataclasses.replace(RECOGNITION, gates=gates)
    gentle = WEIGHTS | {"command_weight": [1e-2], "period": 2e-3}
    law = ScheduledLQR(**gentle, masses=[0.2, 0.6], speeds=[0.5, 1.0], recognition=recognition)
    record = jb.simulate(rig(law, 0.5, speed, duration=1.1, sample_rate=500.0))
    passed = 0.2 - 0.05 / 0.8
    assert np.all(record.command[np.asarray(record.times) < passed] == 0)
    assert np.max(np.abs(record.command)) > 0.01
    found = jb.recognised(record, recognition)
    assert found.speed == pytest.approx(speed, rel=1e-9)
    assert found.speed_error == pytest.approx(0.0, abs=1e-9)
    assert found.mass == pytest.approx(0.5, rel=0.05)
    assert found.mass_error == pytest.approx(found.mass / 0.5 - 1)


@pytest.mark.slow
def test_what_is_recognised_is_followed():
    """Fed the static readings of a mass, its commands become those of a law that is told it."""
    grid = {"masses": [0.2, 0.6], "speeds": [0.5, 1.0]}
    told = ScheduledLQR(**WEIGHTS, **grid)
    law = dataclasses.replace(told, period=jnp.asarray(4e-3), recognition=RECOGNITION)
    case, state = rig(law, 0.3, 0.8), STATES[0]
    layout = lay_out(case)
    times = 0.2 + 0.75 * jnp.array([-0.1, 0.05, 0.1, 0.2, 0.31, 0.6])

    @eqx.filter_jit
    def run(case):
        model = jb.state_space(case, layout=layout)
        memory = case.controller.init(model)
        line, lift = memory[0].identifier.line, memory[0].identifier.lift
        sent = jnp.full(1, 0.7)

        def tick(fit, t):
            place = jnp.asarray(jnp.round((t - 0.2) / 0.75 * 200), int)
            static = 9.81 * 0.3 * line[:, place] + lift @ sent
            readings = jnp.stack([static[0], jnp.asarray(7.0), static[1]])
            before = eqx.tree_at(lambda m: m[0].identifier.fit, memory, fit)
            seen = Measurement(readings, state, sent)
            answer, after = case.controller.step(before, seen, t)
            return after[0].identifier.fit, (answer[0], after[0].identifier.mass)

        return jax.lax.scan(tick, jnp.zeros(2), times)[1]

    answers, mass = run(case)
    assert mass[0] == 0.0
    assert_allclose(mass[1:], 0.3, rtol=1e-9)
    light = dataclasses.replace(told, masses=jnp.array([0.2]))
    assert answers[0] == 0.0
    one = _commands(rig(light, 0.3, 0.8), layout, STATES[:1], times[1:2])
    other = _commands(rig(told, 0.3, 0.8), layout, jnp.tile(STATES[:1], (2, 1)), times[4:])
    assert_allclose(answers[1], one[0, 0], rtol=1e-9)
    assert_allclose(answers[4:], other[:, 0], rtol=1e-7)


def test_a_way_is_found_from_deflections_alone():
    """Static readings, with an offset, of a mass that travels to the left at a steady speed."""
    settings = jb.Recognition(threshold=1e-6, until=0.4)
    case = rig(mass=0.3)
    offset = dataclasses.replace(case.sensors[2], offset=jnp.asarray(1e-4))
    case = dataclasses.replace(case, sensors=(*case.sensors[:2], offset))
    layout = lay_out(case)
    times = 0.004 * jnp.arange(200)

    @eqx.filter_jit
    def run(case):
        model = jb.state_space(case, layout=layout)
        start = settings.identifier(model, model)
        places = jnp.linspace(0, 0.6, start.influence_lines.shape[1])
        sent = jnp.full(1, 0.7)

        def tick(fit, t):
            way = 0.6 - 0.8 * (t - 0.2)
            on = (way > 0) & (way < 0.6)
            line = jax.vmap(lambda each: jnp.interp(way, places, each))(start.influence_lines)
            static = jnp.where(on, 0.3 * 9.81 * line, 0.0) + start.static_lift @ sent
            readings = jnp.stack([static[0], jnp.asarray(7.0), static[1] + 1e-4])
            before = eqx.tree_at(lambda m: m.fit, start, fit)
            after = before.update(Measurement(readings, jnp.zeros(5), sent), t)
            return after.fit, (after.told(t)[0], after.speed, after.entry_time, after.mass)

        return jax.lax.scan(tick, start.sums, times)[1]

    told, speed, entry, mass = map(np.asarray, run(case))
    at = np.argmax(told)
    assert times[at] == pytest.approx(0.2 + 0.4 * 0.75, abs=0.01)
    assert not told[:at].any() and told[at:].all()
    assert_allclose(speed[at:], -0.8, rtol=0.01)
    assert_allclose(entry[at:], 0.2, atol=0.005)
    assert_allclose(mass[at:], 0.3, rtol=0.01)


@pytest.mark.slow
def test_a_load_is_recognised_without_gates():
    recognition = jb.Recognition(threshold=2e-5, until=0.4)
    gentle = WEIGHTS | {"command_weight": [1e-2], "period": 2e-3}
    law = ScheduledLQR(**gentle, masses=[0.2, 0.6], speeds=[0.5, 1.0], recognition=recognition)
    record = jb.simulate(rig(law, 0.5, 0.8, duration=1.1, sample_rate=500.0))
    quiet = np.asarray(record.times) < 0.2 + 0.3 * 0.75
    assert np.all(record.command[quiet] == 0)
    assert np.max(np.abs(record.command)) > 0.01
    found = jb.recognised(record, recognition)
    assert abs(found.speed_error) < 0.1
    assert abs(found.mass_error) < 0.1


def test_a_load_at_rest_is_seen_where_it_is():
    """Everywhere: at the pins rounding is all that bends the beam, and may look like any place."""
    case = rig()
    model = jb.state_space(case)
    follower = jb.Recognition(threshold=1e-9, until=0.9).identifier(model, model)
    places = np.linspace(0.02, 0.58, 5001)
    grid = np.linspace(0, 0.6, follower.influence_lines.shape[1])
    lines = np.stack(
        [np.interp(places, grid, line) for line in np.asarray(follower.influence_lines)], axis=1
    )
    news = np.asarray(
        jax.vmap(lambda seen: follower.innovation(seen, jnp.zeros(())))(jnp.asarray(5.0 * lines))
    )
    assert_allclose(news[:, 3] / news[:, 0], places, atol=1e-3)


def test_influence_and_lift_are_the_static_ones():
    """But for the modes left out: of a beam on pins they are 2 L^3 / (EI pi^4) sum of n^-4."""
    case = rig()
    case = eqx.tree_at(lambda c: c.beam, case, dataclasses.replace(case.beam, modes=12))
    layout = lay_out(case)

    @eqx.filter_jit
    def prepared(case):
        model = jb.state_space(case, layout=layout)
        return RECOGNITION.identifier(model, model)

    found = prepared(case)
    places = jnp.linspace(0, 0.6, found.influence_lines.shape[1])
    tail = 2 * 0.6**3 / (11.68 * np.pi**4) * np.sum(np.arange(13.0, 1000.0) ** -4)
    exact = influence_line(case, jnp.array([0.2, 0.45]), places).T
    assert_allclose(found.influence_lines, exact, rtol=0, atol=tail)
    lift = static_lift(case, jnp.array([0.2, 0.45])).T
    assert_allclose(found.static_lift, lift, rtol=1e-3)


def test_case_files_hold_schedules():
    case = rig(ScheduledLQR(**WEIGHTS, **GRID, period=4e-3, recognition=RECOGNITION))
    check(case)
    assert eqx.tree_equal(case, case_from_dict(case_to_dict(case)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"masses": [0.0, 1.0]}, "masses must list at least one, and positive ones"),
        ({"masses": [1.0, 0.5]}, "masses.1 must be above the entry before it"),
        ({"speeds": [1e-3, 1.0]}, "points must be at least"),
        ({"recognition": RECOGNITION}, "period must be given"),
        (
            {"period": 0.004, "recognition": jb.Recognition([-0.05, -0.15])},
            "recognition.gates must be two places, that which the load passes first",
        ),
        (
            {"period": 0.004, "recognition": jb.Recognition([-0.05, 0.3], until=0.4)},
            "recognition.until must be beyond the second gate, at 0.5 of the way",
        ),
        (
            {"period": 0.004, "recognition": jb.Recognition()},
            "recognition.gates or threshold must be given, and not both",
        ),
        ({"after": "fade"}, "fade_time belongs to after = 'fade'"),
    ],
)
def test_faults_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        check(rig(ScheduledLQR(**WEIGHTS, **(GRID | options))))


def test_one_load_only():
    case = rig(ScheduledLQR(**WEIGHTS, **GRID))
    twice = eqx.tree_at(lambda c: c.loads, case, case.loads * 2)
    with pytest.raises(ValueError, match="kind needs a single load"):
        check(twice)
