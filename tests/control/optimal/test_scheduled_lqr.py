"""Gains scheduled over mass and speed, of loads that are given or identified."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, EstimatedLoads, Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.crossing_gains import GainSchedule, PositionGainLaw
from jaxbeam.control.load_identification import identified_load
from jaxbeam.control.lqr import LQR
from jaxbeam.model.deflection_lines import influence_line, static_deflection_per_command
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.finite_horizon import GainTable

WEIGHTS = {
    "state_weight": [1e3, 1e2, 0.1, 0.01, 0.0],
    "command_weight": [9e-5],
    "coordinates": "sine",
    "points": 210,
}
GRID = {"masses": [0.2, 0.4], "speeds": [1.0, 2.0]}
GATE_IDENTIFICATION = jb.LoadIdentification(gates=[-0.15, -0.05], until=0.3)


def beam_case(controller=None, mass=0.4, speed=1.0, **run):
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
    law = case.controller.law(jb.state_space(case, layout=layout))

    def command(state, t):
        measurement = Measurement(jnp.zeros(3), state, jnp.zeros(1))
        return law.command(jnp.zeros(0), measurement, t)

    return jax.vmap(command)(states, times)


STATES = jnp.asarray(np.random.default_rng(0).normal(size=(3, 5)) * [1e-3, 1e-4, 0.03, 0.01, 0.2])


def commands(controller, shares, mass=0.4, speed=1.0):
    """Commands (share,) for the states at some shares of the crossing."""
    case = beam_case(controller, mass, speed)
    times = 0.2 + 0.6 / abs(speed) * jnp.asarray(shares)
    return np.asarray(_commands(case, mesh_layout(case), STATES, times)[:, 0])


def test_commands_are_interpolated_between_designs():
    """On the grid those of a single design; between, the mean; outside, the nearest, stretched.

    After the crossing the last gain decays.
    """
    shares = [0.1, 0.6, 1.0 + 0.05 / 0.6]
    end = {"terminal_weight": [1e3, 1e2, 0.1, 0.01, 1e-3]}
    scheduled = LQR(
        **WEIGHTS, **GRID, **end, after="fade", fade_time=0.05, horizon="crossing", schedule="load"
    )
    single = LQR(**WEIGHTS, **end, after="hold", horizon="crossing")
    single_designs = {
        (m, v): commands(single, shares, m, v) * [1.0, 1.0, np.exp(-1.0 / v)]
        for m in GRID["masses"]
        for v in GRID["speeds"]
    }
    for at, expected in single_designs.items():
        assert_allclose(commands(scheduled, shares, *at), expected, rtol=1e-9)
    mean = sum(single_designs.values()) / 4
    # At another speed the same share is at another time, so the fading is left out.
    assert_allclose(commands(scheduled, shares, 0.3, 1.5)[:2], mean[:2], rtol=1e-9)
    assert_allclose(
        commands(scheduled, shares, 0.5, 3.0)[:2], single_designs[0.4, 2.0][:2], rtol=1e-9
    )
    nearest = dataclasses.replace(scheduled, between="nearest")
    assert_allclose(
        commands(nearest, shares, 0.26, 1.6)[:2], single_designs[0.2, 2.0][:2], rtol=1e-9
    )


def test_the_weight_of_a_load_beyond_the_designs_is_that_of_the_nearest():
    law = LQR(**WEIGHTS, masses=[0.2, 0.4], horizon="crossing", schedule="load", augmented="loads")
    beyond, heaviest = (commands(law, [0.3, 0.6, 0.9], mass, 2.0) for mass in (0.5, 0.4))
    assert_allclose(beyond, heaviest, rtol=1e-9)


@pytest.mark.parametrize(("fade", "left"), [(None, 1.0), (0.5, np.exp(-2.0))])
def test_gain_before_during_and_after_the_crossing(fade, left):
    fade = None if fade is None else jnp.asarray(fade)
    table = GainTable(jnp.array([0.0, 1.0]), jnp.ones((1, 4, 1, 1)))
    at = jnp.asarray
    schedule = GainSchedule(table, 3 * jnp.ones((1, 1)), jnp.zeros(0), at(1.0), at(2.0), fade)
    assert schedule.gain(at(0.5)) == 0.0
    assert schedule.gain(at(1.5)) == 1 + 0.5 + 0.25 + 0.125
    assert_allclose(schedule.gain(at(3.0)), 3 * left, rtol=1e-12)


@pytest.mark.parametrize("speed", [0.8, -0.8])
def test_load_is_identified_from_gates_in_the_loop(speed):
    """Zero command before the second gate; speed exact, mass to five percent."""
    gates = GATE_IDENTIFICATION.gates if speed > 0 else 0.6 - GATE_IDENTIFICATION.gates
    identification = dataclasses.replace(GATE_IDENTIFICATION, gates=gates)
    gentle = WEIGHTS | {"command_weight": [1e-2], "period": 2e-3}
    law = LQR(
        **gentle,
        masses=[0.2, 0.6],
        speeds=[0.5, 1.0],
        load_identification=identification,
        horizon="crossing",
        schedule="load",
    )
    record = jb.simulate(beam_case(law, 0.5, speed, duration=1.1, sample_rate=500.0))
    passed = 0.2 - 0.05 / 0.8
    assert np.all(record.command[np.asarray(record.times) < passed] == 0)
    assert np.max(np.abs(record.command)) > 0.01
    found = identified_load(record, identification)
    assert found.speed == pytest.approx(speed, rel=1e-9)
    assert found.speed_error == pytest.approx(0.0, abs=1e-9)
    assert found.mass == pytest.approx(0.5, rel=0.05)
    assert found.mass_error == pytest.approx(found.mass / 0.5 - 1)


def test_commands_follow_the_identified_load():
    """With the static readings of a mass, commands tend to those for the given mass."""
    grid = {"masses": [0.2, 0.6], "speeds": [0.5, 1.0]}
    given = LQR(**WEIGHTS, **grid, horizon="crossing", schedule="load")
    law = dataclasses.replace(
        given, period=jnp.asarray(4e-3), load_identification=GATE_IDENTIFICATION
    )
    case, state = beam_case(law, 0.3, 0.8), STATES[0]
    layout = mesh_layout(case)
    times = 0.2 + 0.75 * jnp.array([-0.1, 0.05, 0.1, 0.2, 0.31, 0.6])

    @eqx.filter_jit
    def run(case):
        law = case.controller.law(jb.state_space(case, layout=layout))
        identifier, command = law.law.load_source, jnp.full(1, 0.7)

        def step(law_state, t):
            index = jnp.asarray(jnp.round((t - 0.2) / 0.75 * 200), int)
            line = identifier.influence_lines[:, index]
            static = 9.81 * 0.3 * line + identifier.static_lift @ command
            readings = jnp.stack([static[0], jnp.asarray(7.0), static[1]])
            found = law.step(law_state, Measurement(readings, state, command), t)
            mass = identifier.estimate(found.state[0], t).mass
            return found.state, (found.command[0], mass)

        return jax.lax.scan(step, law.initial_state(), times)[1]

    commands, mass = run(case)
    assert mass[0] == 0.0
    assert_allclose(mass[1:], 0.3, rtol=1e-9)
    light = dataclasses.replace(given, masses=jnp.array([0.2]))
    assert commands[0] == 0.0
    at_lightest_mass = _commands(beam_case(light, 0.3, 0.8), layout, STATES[:1], times[1:2])
    at_given_mass = _commands(
        beam_case(given, 0.3, 0.8), layout, jnp.tile(STATES[:1], (2, 1)), times[4:]
    )
    assert_allclose(commands[1], at_lightest_mass[0, 0], rtol=1e-9)
    assert_allclose(commands[4:], at_given_mass[:, 0], rtol=1e-7)


@pytest.mark.parametrize("speed", [0.8, -0.8])
def test_mass_from_gates_and_static_readings(speed):
    """Of a mass at 0.8 m/s (t - 0.2 s) from the end at which it enters; exact from then on."""
    gates = GATE_IDENTIFICATION.gates if speed > 0 else 0.6 - GATE_IDENTIFICATION.gates
    settings, model = jb.LoadIdentification(gates), jb.state_space(beam_case(speed=speed))
    identifier = settings.identifier(model, model)
    sums, positions = identifier.initial_state(), np.linspace(0.0, 0.6, 201)
    for t in 0.2 + 0.6 / 0.8 * np.array([-0.02, 0.04, 0.15, 0.25, 0.31]):
        place = 0.8 * (t - 0.2) if speed > 0 else 0.6 - 0.8 * (t - 0.2)
        line = [np.interp(place, positions, one) for one in identifier.influence_lines]
        line = np.array(line) * (0 < place < 0.6)
        readings = np.array([9.81 * 0.3 * line[0], 7.0, 9.81 * 0.3 * line[1]])
        found, sums = identifier.update(sums, Measurement(readings, np.zeros(5), np.zeros(1)), t)
    assert found.mass_identified
    assert_allclose([found.mass, found.speed, found.entry_time], [0.3, speed, 0.2], rtol=1e-9)


def test_speed_and_mass_from_deflections_without_gates():
    """Static readings, with an offset, of a mass that moves to the left at constant speed."""
    settings = jb.LoadIdentification(threshold=1e-6, until=0.4)
    case = beam_case(mass=0.3)
    offset = dataclasses.replace(case.sensors[2], offset=jnp.asarray(1e-4))
    case = dataclasses.replace(case, sensors=(*case.sensors[:2], offset))
    layout = mesh_layout(case)
    times = 0.004 * jnp.arange(200)

    @eqx.filter_jit
    def run(case):
        model = jb.state_space(case, layout=layout)
        identifier, command = settings.identifier(model, model), jnp.full(1, 0.7)
        lines = identifier.influence_lines
        positions = jnp.linspace(0, 0.6, lines.shape[1])

        def step(sums, t):
            position = 0.6 - 0.8 * (t - 0.2)
            on_beam = (position > 0) & (position < 0.6)
            influence = jax.vmap(lambda line: jnp.interp(position, positions, line))(lines)
            static = jnp.where(on_beam, 0.3 * 9.81 * influence, 0.0)
            static = static + identifier.static_lift @ command
            readings = jnp.stack([static[0], jnp.asarray(7.0), static[1] + 1e-4])
            measurement = Measurement(readings, jnp.zeros(5), command)
            estimate, sums = identifier.update(sums, measurement, t)
            return sums, estimate

        return jax.lax.scan(step, identifier.initial_state(), times)[1]

    mass, speed, entry, identified, _ = map(np.asarray, run(case))
    at = np.argmax(identified)
    assert times[at] == pytest.approx(0.2 + 0.4 * 0.75, abs=0.01)
    assert not identified[:at].any() and identified[at:].all()
    assert_allclose(speed[at:], -0.8, rtol=0.01)
    assert_allclose(entry[at:], 0.2, atol=0.005)
    assert_allclose(mass[at:], 0.3, rtol=0.01)


def test_position_of_a_load_at_rest():
    """Anywhere: near the pins deflections are rounding, whose ratio may fit any position."""
    case = beam_case()
    model = jb.state_space(case)
    identifier = jb.LoadIdentification(threshold=1e-9, until=0.9).identifier(model, model)
    positions = np.linspace(0.02, 0.58, 5001)
    grid = np.linspace(0, 0.6, identifier.influence_lines.shape[1])
    lines = np.stack(
        [np.interp(positions, grid, line) for line in np.asarray(identifier.influence_lines)],
        axis=1,
    )
    start, t = identifier.initial_state(), jnp.zeros(())
    increments = jax.vmap(lambda deflections: identifier.increments(start, deflections, t))
    found = np.asarray(increments(jnp.asarray(5.0 * lines)))
    assert_allclose(found[:, 3] / found[:, 0], positions, atol=1e-3)


def test_influence_lines_and_lift_are_static():
    """Up to the truncation of modes: 2 L^3 / (EI pi^4) sum of n^-4 on a pinned beam."""
    case = beam_case()
    case = eqx.tree_at(lambda c: c.beam, case, dataclasses.replace(case.beam, modes=12))
    layout = mesh_layout(case)

    @eqx.filter_jit
    def identifier_of(case):
        model = jb.state_space(case, layout=layout)
        return GATE_IDENTIFICATION.identifier(model, model)

    found = identifier_of(case)
    positions = jnp.linspace(0, 0.6, found.influence_lines.shape[1])
    tail = 2 * 0.6**3 / (11.68 * np.pi**4) * np.sum(np.arange(13.0, 1000.0) ** -4)
    exact = influence_line(case, jnp.array([0.2, 0.45]), positions).T
    assert_allclose(found.influence_lines, exact, rtol=0, atol=tail)
    lift = static_deflection_per_command(case, jnp.array([0.2, 0.45])).T
    assert_allclose(found.static_lift, lift, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"masses": [0.0, 1.0]}, "masses must list at least one, and positive ones"),
        ({"masses": [1.0, 0.5]}, "masses.1 must be above the entry before it"),
        ({"speeds": [1e-3, 1.0]}, "points must be at least"),
        ({"load_identification": GATE_IDENTIFICATION}, "period must be given"),
        (
            {"period": 0.004, "load_identification": jb.LoadIdentification([-0.05, -0.15])},
            "load_identification.gates must be two positions, the one that the load passes",
        ),
        (
            {
                "period": 0.004,
                "load_identification": jb.LoadIdentification([-0.05, 0.3], until=0.4),
            },
            "load_identification.until must be beyond the second gate, at 0.5 of the crossing",
        ),
        (
            {"period": 0.004, "load_identification": jb.LoadIdentification()},
            "load_identification.gates or threshold must be given, and not both",
        ),
        ({"after": "fade"}, "fade_time belongs to after = 'fade'"),
    ],
)
def test_errors_of_settings(options, message):
    with pytest.raises(ValueError, match=message):
        check_case(
            beam_case(LQR(**WEIGHTS, **(GRID | options), horizon="crossing", schedule="load"))
        )


def test_several_loads_are_refused():
    case = beam_case(LQR(**WEIGHTS, **GRID, horizon="crossing", schedule="load"))
    twice = eqx.tree_at(lambda c: c.loads, case, case.loads * 2)
    with pytest.raises(ValueError, match="schedule needs a single load"):
        check_case(twice)


# Gains of single loads read by the positions of several loads, of varying speed.

POSITION_WEIGHTS = {"state_weight": [1e4, 1.0], "command_weight": [1e-3], "points": 40}
BRAKING = jb.MovingMass(mass=0.3, speed=2.0, entry_time=0.1, deceleration=1.5)
SECOND = jb.MovingMass(mass=0.2, speed=2.5, entry_time=0.2)
LENGTH, MASSES, SPEEDS = 0.6, np.array([0.1, 0.4]), np.array([1.0, 3.0])
REST = Measurement(np.zeros(1), np.zeros(2), np.zeros(1))


def position_beam_case(controller, loads=(BRAKING,), duration=0.7) -> jb.Case:
    return jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, 0.03, modes=1),
        actuators=[jb.PointForce(0.25)],
        sensors=[jb.Sensor(0.3)],
        loads=list(loads),
        controller=controller,
        run=jb.Run(duration, 200.0),
    )


def polynomial_law(loads) -> PositionGainLaw:
    """Law whose gains of the two states and the weight are known polynomials of the position.

    K(m, v, x) = (m + v) (1 + 2 s, s, s^2) at a share s, linear in mass and speed.
    """
    powers = np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    ends, zero, fade = np.array([0.0, 1.0]), np.zeros(()), np.array(0.05)

    def schedule(size):
        table, final = GainTable(ends, size * powers[None, :, None]), size * np.eye(1, 3) * 5.0
        return GainSchedule(table, final, np.zeros(1), zero, np.ones(()), fade, True)

    designs = [schedule(mass + speed) for mass in MASSES for speed in SPEEDS]
    schedules = jax.tree.map(lambda *x: jnp.stack(x).reshape(2, 2, *x[0].shape), *designs)
    mass = jnp.array([float(load.mass) for load in loads])
    moving = load_set(position_beam_case(None, loads))
    return PositionGainLaw(schedules, MASSES, SPEEDS, mass, 9.81 * mass, moving)


def expected_command(loads, x, t):
    """Command by the positions x = v t - a t^2 / 2 of loads that enter at the left."""
    feedback, forward, total = np.zeros(2), 0.0, 0.0
    for load in loads:
        since = t - float(load.entry_time)
        position = float(load.speed) * since - float(load.deceleration) * since**2 / 2
        speed = float(load.speed) - float(load.deceleration) * since
        share, mass = position / LENGTH, float(load.mass)
        if since < 0 or share > 1:
            continue
        size = mass + speed
        feedback += mass * size * np.array([1 + 2 * share, share])
        forward += size * share**2 * mass * 9.81
        total += mass
    return -feedback @ x / total - forward


@pytest.mark.parametrize("t", [0.15, 0.23, 0.3, 0.42])
def test_gains_are_read_by_position_and_combined(t):
    """First one load, then two, then the one that brakes alone: it stays longer than at 2 m/s."""
    loads, x = (BRAKING, SECOND), np.array([0.7, -0.4])
    command = polynomial_law(loads).step((), Estimate(jnp.asarray(x)), REST, jnp.asarray(t)).command
    assert_allclose(command, expected_command(loads, x, t), rtol=1e-9)


def test_before_the_entry_and_after_the_exit():
    """Then the final gain of the loads fades, each from its own exit, averaged by mass."""
    law, x = polynomial_law((BRAKING, SECOND)), Estimate(jnp.array([1.0, 0.0]))
    assert law.step((), x, REST, jnp.asarray(0.05)).command == 0.0
    leave = np.array([0.1 + (2.0 - np.sqrt(4.0 - 2 * 1.5 * LENGTH)) / 1.5, 0.2 + LENGTH / 2.5])
    gone = 0.6 - leave
    exit_speeds = np.array([2.0 - 1.5 * (0.6 - 0.1), 2.5])
    sizes = np.array([0.3, 0.2]) + np.maximum(exit_speeds, 1.0)
    expected = np.array([0.3, 0.2]) @ (5.0 * sizes * np.exp(-gone / 0.05)) / 0.5
    assert_allclose(law.step((), x, REST, jnp.asarray(0.6)).command, -expected, rtol=1e-9)


@pytest.mark.parametrize("t", [0.23, 0.42])
def test_loads_that_go_left_are_read_by_their_way_from_the_right(t):
    """Those of the case, and those of an estimate at the same places."""
    x = np.array([0.7, -0.4])
    left = [dataclasses.replace(load, speed=-load.speed) for load in (BRAKING, SECOND)]
    law, time = polynomial_law(left), jnp.asarray(t)
    positions, speeds, _ = law.load_set.kinematics(np.asarray(t))
    followed = EstimatedLoads(law.load_masses, positions, speeds)
    for estimate in (Estimate(jnp.asarray(x)), Estimate(jnp.asarray(x), loads=followed)):
        command = law.step((), estimate, REST, time).command
        assert_allclose(command, expected_command((BRAKING, SECOND), x, t), rtol=1e-9)


def test_estimated_loads_that_have_left_fade_from_their_exits():
    """They left at their speeds: at 0.04 m and 0.1 m beyond the end 0.02 s and 0.04 s ago."""
    masses, speeds = np.array([0.3, 0.2]), np.array([2.0, 2.5])
    followed = EstimatedLoads(masses, LENGTH + np.array([0.04, 0.1]), speeds)
    law, estimate = polynomial_law((BRAKING, SECOND)), Estimate(jnp.array([1.0, 0.0]))
    found = law.step((), estimate._replace(loads=followed), REST, jnp.asarray(0.5)).command
    fading = np.exp(-np.array([0.02, 0.04]) / 0.05)
    assert_allclose(found, -masses @ (5.0 * (masses + speeds) * fading) / 0.5, rtol=1e-9)


def regulators():
    single = jb.LQR(**POSITION_WEIGHTS, horizon="crossing")
    return single, jb.LQR(
        **POSITION_WEIGHTS, masses=[0.3], horizon="crossing", schedule="positions"
    )


def test_one_load_of_the_design_at_constant_speed():
    """The commands are those of the optimal regulator, by time."""
    steady = (eqx.tree_at(lambda load: load.deceleration, BRAKING, np.zeros(())),)
    times, x = jnp.array([0.12, 0.25, 0.38]), jnp.array([1e-3, 2e-2])

    @eqx.filter_jit
    def commands(case, layout):
        law = case.controller.law(jb.state_space(case, layout=layout)).law
        return jnp.stack([law.step((), Estimate(x), REST, t).command for t in times])

    cases = [position_beam_case(law, steady) for law in regulators()[::-1]]
    found, expected = (commands(case, mesh_layout(case)) for case in cases)
    assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    ("settings", "loads", "message"),
    [
        ({}, (jb.MovingForce(mass=0.2, times=[0.0, 0.3], positions=[0.0, 0.5]),), "speeds must"),
        (
            {},
            (BRAKING, jb.MovingMass(mass=0.2, speed=-1.0)),
            "schedule needs loads that all travel in one direction",
        ),
        ({"masses": []}, (BRAKING,), "masses must list at least one"),
        ({"entries": "predicted"}, (BRAKING,), "entries must be 'measured'"),
        ({}, (jb.Oscillator(0.3, 900.0, 2.0, speed=15.0),), "schedule needs loads of one wheel"),
    ],
)
def test_errors_of_settings_of_position(settings, loads, message):
    law = jb.LQR(
        **POSITION_WEIGHTS,
        **({"masses": [0.2]} | settings),
        horizon="crossing",
        schedule="positions",
    )
    with pytest.raises(ValueError, match=f"^controller.{message}"):
        check_case(position_beam_case(law, loads))
