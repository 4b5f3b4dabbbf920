"""Scenario MPC: one scenario is MPC; several, against programs of scipy's plants by Clarabel."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, Measurement
from jaxbeam.case.validation import check_case
from tests.control.predictive.test_mpc_exact import affine, by_clarabel

PERIOD, LIMITS, MOVE_WEIGHT = 0.01, (-4.0, 6.0), 1e-9
BASE = {"horizon": 4, "moves": 3, "move_weight": MOVE_WEIGHT, "period": PERIOD}
STIFFNESS, DELAYS = [0.8, 1.0, 1.2], [0.0, 0.003, 0.006]
BEAM = {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535}
RANDOM = np.random.default_rng(8)
STATES = RANDOM.normal(size=(3, 4)) * [2e-4, 3e-5, 1e-2, 5e-3]


def scenario_case(controller, stiffness=1.0) -> jb.Case:
    beam = BEAM | {"flexural_rigidity": 11.68 * stiffness}
    return jb.Case(
        jb.Beam(**beam, damping_ratio=0.03, modes=2),
        actuators=[jb.PointForce(0.25, limits=list(LIMITS))],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=2.0)],
        controller=controller,
        run=jb.Run(0.4),
    )


def commands_of(controller, states=STATES) -> np.ndarray:
    """Commands for states at successive samples, and whether all were found."""
    law = controller.law(jb.state_space(scenario_case(controller)))
    state, command, found = law.initial_state(), np.zeros(1), []
    for k, x in enumerate(states):
        measurement = Measurement(np.zeros(1), x, command)
        command, state, solved = law.step(state, measurement, np.asarray(k * PERIOD))
        assert solved
        found.append(command)
    return np.array(found)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"hard_limit": 1.2e-3, "soft_limit": 2e-4, "soft_weight": 3.0, "delay": 0.002},
        {"loads": "known", "prediction": "time-varying", "terminal": "riccati"},
        {"solver": "unconstrained"},
    ],
)
def test_one_scenario_is_predictive_control(settings):
    settings = BASE | settings
    expected = commands_of(jb.MPC(**settings))
    assert np.ptp(expected) > 0.1
    assert_allclose(commands_of(jb.ScenarioMPC(**settings)), expected, rtol=0, atol=1e-9)


def test_equal_scenarios_are_predictive_control():
    settings = BASE | {"soft_limit": 2e-4, "soft_weight": 3.0}
    equal = jb.ScenarioMPC(**settings, mass_factors=1.0, stiffness_factors=[1.0, 1.0])
    assert_allclose(commands_of(equal), commands_of(jb.MPC(**settings)), rtol=0, atol=1e-8)


def test_factors_are_those_of_cases():
    """A scenario is the plant of a case with that rigidity and mass."""
    varying = BASE | {"loads": "known", "prediction": "time-varying"}
    case = scenario_case(None, 1.3)
    case = dataclasses.replace(case, loads=(jb.MovingMass(mass=0.2, speed=2.0),))
    of_case = jb.MPC(**varying, nominal_plant=jb.state_space(case))
    factors = jb.ScenarioMPC(**varying, mass_factors=[0.5], stiffness_factors=[1.3])
    assert_allclose(commands_of(factors), commands_of(of_case), rtol=0, atol=1e-7)


def test_estimated_weights_count_by_their_factors():
    """A single scenario of half the masses is predictive control with half the weight."""
    varying = BASE | {"loads": "known"}
    found = []
    for controller, weight in (
        (jb.ScenarioMPC(**varying, mass_factors=[0.5]), 4.0),
        (jb.MPC(**varying), 2.0),
    ):
        law = controller.law(jb.state_space(scenario_case(controller))).law
        measurement = Measurement(np.zeros(1), STATES[0], np.zeros(1))
        estimate = Estimate(STATES[0], np.array([weight]))
        found.append(law.step(law.initial_state(), estimate, measurement, np.asarray(0.1)).command)
    assert_allclose(*found, rtol=0, atol=1e-9)
    assert abs(found[0]) > 0.1


class Futures:
    """Deflections of each scenario from its own plant and unexplained change, by scipy."""

    def __init__(self):
        self.C = np.append(np.sin(np.pi / 2 * np.arange(1, 3)) * np.sqrt(2 / (0.535 * 0.6)), [0, 0])
        self.plants = []
        for stiffness, delay in zip(STIFFNESS, DELAYS, strict=True):
            plant = jb.state_space(scenario_case(None, stiffness)).unloaded
            A, B = np.asarray(plant.A), np.asarray(plant.B)
            matrices = A, B, self.C[None], np.zeros((1, 1))
            transition, whole = scipy.signal.cont2discrete(matrices, PERIOD)[:2]
            late = scipy.signal.cont2discrete(matrices, PERIOD - delay)[1]
            self.plants.append((transition, (whole - late)[:, 0], late[:, 0]))

    def deflections(self, scenario, x, unexplained, previous, moves):
        A, early, late = self.plants[scenario]
        commands = previous + np.cumsum(np.append(moves, 0.0))
        found = []
        for before, command in zip(np.append(previous, commands), commands, strict=False):
            x = A @ x + early * before + late * command + unexplained
            found.append(self.C @ x)
        return 1e6 * np.array(found)


@pytest.mark.parametrize(("merit", "hard_limit"), [("mean", 1.2e-3), ("worst", None)])
def test_commands_against_an_independent_program(merit, hard_limit):
    controller = jb.ScenarioMPC(
        **BASE, stiffness_factors=STIFFNESS, delays=DELAYS, merit=merit, hard_limit=hard_limit
    )
    found, futures, active = commands_of(controller)[:, 0], Futures(), 0
    past, older, previous, root = np.zeros(4), 0.0, 0.0, 1e6 * np.sqrt(MOVE_WEIGHT)
    for x, command in zip(STATES, found, strict=True):
        # The state before also has the command that was acting then.
        unexplained = [
            x - (A @ past + early * older + late * previous) for A, early, late in futures.plants
        ]

        def outputs(moves, x=x, unexplained=unexplained, previous=previous):
            rows = [
                futures.deflections(i, x, own, previous, moves) for i, own in enumerate(unexplained)
            ]
            return np.concatenate(rows)

        free, slopes = affine(outputs, 3)
        sums = np.tril(np.ones((3, 3)))
        M = np.vstack([sums, -sums])
        gamma = np.append(np.full(3, LIMITS[1] - previous), np.full(3, previous - LIMITS[0]))
        if merit == "mean":
            H, f = slopes.T @ slopes / 3 + root**2 * np.eye(3), slopes.T @ free / 3
            allowed = 1e6 * float(hard_limit)
            M = np.vstack([M, slopes, -slopes])
            gamma = np.concatenate([gamma, allowed - free, allowed + free])
        else:
            H, f = np.diag([root**2] * 3 + [4.0]), np.zeros(4)
            excess = -np.ones((24, 1))
            M = np.vstack(
                [np.pad(M, ((0, 0), (0, 1))), np.hstack([np.vstack([slopes, -slopes]), excess])]
            )
            gamma = np.concatenate([gamma, -free, free])
        best = by_clarabel(2 * H, 2 * f, M, gamma)
        assert_allclose(command, previous + best[0], rtol=0, atol=1e-5)
        if merit == "mean":
            active += np.max(np.abs(outputs(best))) > allowed - 1e-3
        past, older, previous = x, previous, command
    assert merit == "worst" or active > 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"delays": [0.0, 0.01]}, "delays must be less than the period"),
        (
            {"delays": [0.0, 0.001, 0.002], "stiffness_factors": [1.0, 1.1]},
            "stiffness_factors must",
        ),
        ({"mass_factors": [1.0, 2.0]}, "mass_factors must be left out: the prediction has no"),
        ({"merit": "worst", "terminal": "riccati"}, "terminal must be 'none' with the merit"),
        ({"terminal": "dual-mode", "moves": 4}, "no set serves all scenarios"),
        ({"merit": "worst", "solver": "unconstrained"}, "solver must not be 'unconstrained'"),
    ],
)
def test_errors_of_settings(settings, words):
    with pytest.raises(ValueError, match=words):
        check_case(scenario_case(jb.ScenarioMPC(**BASE | settings)))
