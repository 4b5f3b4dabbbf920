"""What is written, or handed to other packages, refuses traced numbers in one sentence."""

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.analysis.combinations import combine
from jaxbeam.analysis.load_models import crossing_envelope, load_model_envelope
from jaxbeam.analysis.margins import stability_margin
from jaxbeam.analysis.sections import influence_table, record_amplification

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.3)],
    actuators=[jb.PointForce(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    run=jb.Run(0.1, 100.0),
)
MASS, RIGIDITY = "loads.0.mass", "beam.flexural_rigidity"
REFUSED = {
    "amplification of a record": lambda case, _: record_amplification(jb.simulate(case)),
    "python-control, plant and loop": lambda case, path: jb.to_control(case),
    "python-control": lambda case, path: jb.state_space(case).unloaded.to_control(),
    "MATLAB": lambda case, path: jb.state_space(case).unloaded.to_mat(path / "plant.mat"),
    "file": lambda case, path: jb.save(jb.simulate(case), path / "run.csv"),
    "table": lambda case, path: jb.simulate(case).columns,
    "figure": lambda case, path: jb.simulate(case).plot(),
    "load model": lambda case, path: load_model_envelope(case, "HL-93", [0.3]),
    "crossing of a load model": lambda case, path: crossing_envelope(case, "HL-93", 2.0, [0.3]),
    "combinations": lambda case, path: combine(
        case, {"deck": {"uniform": "20 N/m"}}, {"all": {"deck": 1.35}}, [0.3]
    ),
    "influences": lambda case, path: influence_table(case),
    "margin": lambda case, path: stability_margin(case),
    "dataset": lambda case, path: jb.simulate(case).to_xarray(),
}
OF_PLANTS = "python-control, plant and loop", "python-control", "MATLAB"
TRANSFORMED = {
    "grad": lambda function: jax.jvp(function, (1.0,), (1.0,)),
    "jit": lambda function: jax.jit(function)(1.0),
    "vmap": lambda function: jax.vmap(function)(np.array([0.8, 1.0])),
}


@pytest.mark.parametrize("transformed", ["jit", "vmap"])
def test_the_verdict_of_a_compiled_run_is_refused(transformed):
    def function(share):
        return jb.simulate(jb.replace(CASE, {MASS: 0.3 * share})).verdict

    with pytest.raises(ValueError, match="a verdict can be neither differentiated nor compiled"):
        TRANSFORMED[transformed](function)


@pytest.mark.parametrize("transformed", TRANSFORMED)
def test_a_traced_record_says_that_it_is_one(transformed):
    texts = []

    def function(share):
        texts.append(repr(jb.simulate(jb.replace(CASE, {MASS: 0.3 * share}))))
        return share

    TRANSFORMED[transformed](function)
    assert all("traced or of several runs" in text for text in texts)


@pytest.mark.parametrize("transformed", TRANSFORMED)
@pytest.mark.parametrize("name", REFUSED)
def test_traced_numbers_are_refused(name, transformed, tmp_path):
    address = RIGIDITY if name in OF_PLANTS else MASS

    def function(share):
        value = share * float(jb.addresses(CASE)[address])
        REFUSED[name](jb.replace(CASE, {address: value}), tmp_path)
        return share

    with pytest.raises(ValueError, match="can be neither differentiated nor compiled: call it"):
        TRANSFORMED[transformed](function)
    assert not list(tmp_path.iterdir())
