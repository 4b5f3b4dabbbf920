"""Parts of case files, and names that differ between versions."""

import inspect
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxbeam as jb

BEAM = """
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = 0.03
modes = 3
"""
PATCH_BEAM = """
[beam]
length = 0.6
flexural_rigidity = 13.211
mass_per_length = 0.812
damping_ratio = 0.03
modes = 3
"""
TWO_SPANS = """
[beam]
length = 1.2
flexural_rigidity = 12.277
mass_per_length = 0.7924
damping_ratio = 0.03
modes = 5
[[supports]]
position = 0.6
"""
MASS = """
[[loads]]
kind = "mass"
mass = 0.5
speed = 1.2
entry_time = 0.05
"""
PATCH = """
[[actuators]]
kind = "patch"
start = 0.2575
end = 0.3425
moment_per_volt = 8.292e-4
correction = 0.32
amplifier_gain = 200.0
limits = [-2.5, 7.5]
"""
SHAKER = """
[[actuators]]
kind = "shaker"
position = 0.5
stiffness = 3500.0
damping = 80.0
force_per_volt = 4.6
bandwidth = 2000.0
limits = [-10.0, 10.0]
"""
MIDSPAN = """
[[sensors]]
position = 0.3
"""
RUN = """
[run]
duration = 0.8
sample_rate = 250.0
"""
CUBIC = """
[controller]
kind = "feedback"
gains = [2.0e9]
power = 3
period = 0.004
"""


def read(*parts: str) -> jb.Case:
    """The case that parts of a case file describe."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.toml"
        path.write_text("".join(parts), encoding="utf-8")
        return jb.load_case(path)


def word(new: str, old: str) -> str:
    """A word of case files or of the command line in the version that is imported."""
    return new if "Feedforward" in jb.__all__ else old


def first_of(thing: Any, *names: str) -> Any:
    """The attribute under the first of some names that exists, newest name first.

    Raises AttributeError if there is none.
    """
    for name in names:
        if hasattr(thing, name):
            return getattr(thing, name)
    raise AttributeError(f"{thing!r} has none of {', '.join(names)}")


def argument(function: Callable, *names: str) -> str:
    """The first of some names that is an argument of a function, newest name first."""
    parameters = inspect.signature(function).parameters
    return next(name for name in names if name in parameters)
