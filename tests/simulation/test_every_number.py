"""The derivative by every declared number of every kind equals differences, or is refused.

The classes of a case and of its parts are walked: each number that they declare is one of a case
of `cases_of_numbers`, where it is not zero and changes the run. A number without such a case fails
a test, so that a new kind, or a new number of one, needs a case.
"""

import dataclasses
import inspect

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import leaves_by_address
from jaxbeam.case.fields import PACKAGES, import_modules
from jaxbeam.case.loads.vehicles import PlanarVehicle
from jaxbeam.runtime.arrays import Module, xp
from tests.differences import central
from tests.simulation.cases_of_numbers import CASES, JUMPING

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # of lost contact, of sizes

# Numbers with which a run jumps, by name, and the sentence that refuses their derivatives.
DECIDES = "decides at samples, so that commands jump with it and it has no derivative"
JUMPS = {
    "resolution": "jumps with it, so that it has no derivative",
    "dropout": "is drawn by a seed and jumps with the dropout",
    "jitter": "is drawn by a seed and jumps with the jitter",
    "until": DECIDES,
    "threshold": DECIDES,
    "confirmation": DECIDES,
    "stepped masses": DECIDES,
}
# Those of an internal model that is scheduled, which counts the commands on their way.
COUNTS = "needs concrete delays: leave period and delays out of what is traced"
STEP, TOLERANCE = 4e-6, 1e-4  # of numbers; of the largest derivative of an output
# Where runs repeat less exactly, as numbers pass equations of Riccati. The disagreement falls as
# the step grows, so that it is rounding of the differences: that by the attenuation is 13, 1.1, 0.9
# and 0.1 times the tolerance with 4e-5, 4e-4, 1e-3 and 2e-3, that by the deviation of the speed of
# an extended filter 4.2, 0.94, 0.36 and 0.04 times with 1e-4, 3e-4, 1e-3 and 3e-3, and 2.6 in
# second order. Not of times, which reorder events. These differences are of fourth order.
LARGER_STEPS = {"h-infinity": 2e-3, "dlqr-kalman": 1e-4, "kalman-extended": 3e-3}
TIMES = ("period", "delay")

# Numbers that do not matter in these cases, or never.
WITHOUT_EFFECT = {
    "absorbers": {"absorbers.1.max_stroke"},
    "forces": {"loads.3.tail"},
    "hysteresis and creep": {"actuators.0.depolarisation"},
    "patches": {"actuators.0.depolarisation", "actuators.1.depolarisation"},
    "lqr-scheduled": {"controller.load_identification.gates"},  # exact, wherever they are
    "moving-horizon": {"controller.estimator.min_weight"},
    "moving-horizon of a heavy load": {"controller.estimator.max_weight"},
    **dict.fromkeys(("mpc", "mpc-dual-mode", "mpc-scenario"), {"controller.soft_weight"}),
    "run": {"run.duration"},
    "even track": {"track.sleeper_spacing"},
    "uneven track": {"track.sleeper_spacing"},
}
NEVER_OF_EFFECT = {
    ("SpringDamper", "limits"),  # it takes no commands
    ("Absorber", "max_stroke"),  # a run beyond it is warned of
    ("Run", "duration"),  # on peaks before the end; see `test_moving_events`
    # Their contact has no derivatives at all; see `test_unilateral`.
    ("UnilateralContact", "stiffness"),
    ("UnilateralContact", "hertz_stiffness"),
}


def outputs(case: jb.Case):
    """Peaks, deflections, readings and commands of a run."""
    record = jb.simulate(case, tolerance=1e-9)
    end = record.times.size - 1
    parts = [record.peak_deflection]
    for share in (0.3, 0.62, 0.9):
        i = int(share * end)
        parts += [record.deflection[i], record.sensor_values[i], record.measured[i]]
        parts += [] if record.command is None else [record.command[i]]
    parts += [record.vehicle_readings[int(0.62 * end)]] if case.vehicle_sensors else []
    return xp.concatenate([xp.reshape(part, -1) for part in parts])


def numbers(case: jb.Case, of) -> list[str]:
    """Addresses of numbers that are not zero, each list as one, of parts of a case."""
    found = leaves_by_address(case).items()
    return [address for address, value in found if address.startswith(of) and np.any(value)]


def jumps(case: jb.Case, address: str) -> str:
    """The sentence that refuses the derivative by a number; "" if there is none."""
    stepped = getattr(case.controller, "between", "") == "stepped"
    part, name = address.partition(".")[0], address.rpartition(".")[2]
    kind = getattr(case.controller, "kind", "")
    if kind == "internal-model-scheduled" and name in ("period", "delay"):
        return COUNTS
    if part == "vehicle_sensors" and name == "jitter":
        return ""  # no law waits for these readings, which are taken from a smooth history
    return JUMPS.get(f"stepped {name}" if stepped and name == "masses" else name, "")


def moved(case: jb.Case, addresses, shares) -> jb.Case:
    """The case with numbers increased by shares of themselves, other ones for each entry."""
    leaves, structure = jax.tree.flatten(case)
    index = {address: i for i, address in enumerate(leaves_by_address(case))}
    for address, share in zip(addresses, shares, strict=True):
        value = leaves[index[address]]
        entries = 1 + 0.3 * np.cos(1.0 + np.arange(np.size(value)))
        leaves[index[address]] = value * (1 + share * entries.reshape(np.shape(value)))
    return jax.tree.unflatten(structure, leaves)


COMPARED = [name for name in CASES if name not in JUMPING]


@pytest.mark.parametrize("name", [*COMPARED, "vehicle_sensors jump"])
def test_derivatives_equal_differences(name):
    case, of = CASES[name]
    smooth = [address for address in numbers(case, of) if not jumps(case, address)]

    def function(shares):
        return outputs(moved(case, smooth, shares))

    found = np.asarray(jax.jacfwd(function)(np.zeros(len(smooth))))
    steps = np.array(
        [STEP if address.endswith(TIMES) else LARGER_STEPS.get(name, STEP) for address in smooth]
    )
    order = 4 if name in LARGER_STEPS else 2
    expected = central(lambda counts: function(counts * steps), 0 * steps, 1.0, order) / steps
    sizes = np.maximum(np.abs(function(np.zeros(len(smooth)))), 1e-12)
    without_effect = set()
    for i, address in enumerate(smooth):
        ours, differences = found[:, i] / sizes, expected[:, i] / sizes
        largest = np.abs(differences).max()
        # The absolute part is the tolerance of the run over the step.
        bound = TOLERANCE * np.abs(differences) + 1e-6 * (1 + largest)
        assert np.all(np.abs(ours - differences) <= bound), address
        if largest < 1e-7:
            without_effect.add(address)
    assert without_effect == WITHOUT_EFFECT.get(name, set())


JUMPING_NUMBERS = [
    (name, address)
    for name, (case, of) in CASES.items()
    for address in numbers(case, of)
    if jumps(case, address)
]


@pytest.mark.parametrize(("name", "address"), JUMPING_NUMBERS)
def test_derivatives_of_jumps_are_refused(name, address):
    case, _ = CASES[name]
    with pytest.raises(ValueError, match=jumps(case, address)):
        jax.jvp(lambda share: outputs(moved(case, [address], [share])), (0.0,), (1.0,))


def subclasses(part_class: type) -> set[type]:
    direct = part_class.__subclasses__()
    return set(direct).union(*map(subclasses, direct))


def declaring(part_class: type, name: str) -> tuple[str, str]:
    """The first class that declares a number, and its name: what is inherited needs one case."""
    owners = [
        one
        for one in part_class.__mro__
        if "unit" in getattr(vars(one).get("__dataclass_fields__", {}).get(name), "metadata", {})
    ]
    return owners[-1].__name__, name


def declared_numbers() -> set[tuple[str, str]]:
    """All numbers that classes of jaxbeam declare, but those that vehicle files alone have."""
    for package in PACKAGES:
        import_modules(package)
    return {
        declaring(part_class, field.name)
        for part_class in subclasses(Module) - {PlanarVehicle}
        if part_class.__module__.startswith("jaxbeam.")
        and not inspect.isabstract(part_class)
        and dataclasses.is_dataclass(part_class)
        for field in dataclasses.fields(part_class)
        if "unit" in field.metadata
    }


def owner(case: jb.Case, address: str):
    """The part of a case that has the number at an address."""
    part = case
    for key in address.split(".")[:-1]:
        part = part[int(key)] if isinstance(part, tuple) else getattr(part, key)
    return part


def test_every_declared_number_has_a_case():
    covered = {
        declaring(type(owner(case, address)), address.rpartition(".")[2])
        for name, (case, of) in CASES.items()
        for address in numbers(case, of)
        if address not in WITHOUT_EFFECT.get(name, ())
    }
    assert declared_numbers() - covered == NEVER_OF_EFFECT
