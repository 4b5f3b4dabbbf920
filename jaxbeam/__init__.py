"""jaxbeam: structures under moving loads, simulated and differentiated with JAX."""

import os

# Matrices are small here, and runs share the cores already: threads of LAPACK would wait for each
# other, on a busy machine for minutes. LAPACK reads this as it is loaded; a setting given stays.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax

# Peaks to one part in a million need double precision; whoever asks JAX for single keeps it.
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)

from jaxbeam.analysis.bound.bound import bound
from jaxbeam.case.actuators import Electrodynamic, Patch, PointForce, Shaker, SpringDamper
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, Run, addresses, replace
from jaxbeam.case.filters import Filter
from jaxbeam.case.loads import MovingForce, MovingMass
from jaxbeam.case.sensors import Sensor
from jaxbeam.control import (
    LQR,
    MPC,
    PD,
    AugmentedLQR,
    DiscreteLQR,
    Feedback,
    FiniteLQR,
    Lead,
    Passage,
    PositivePositionFeedback,
    Prescribed,
    Recognition,
    Relief,
    ScheduledFeedback,
    ScheduledLQR,
    StateFeedback,
    StepLQR,
    recognised,
    sampling_limit,
)
from jaxbeam.estimation import Inversion, Kalman, Observer
from jaxbeam.files.case_file import load_case, save_case
from jaxbeam.model.modes import modes
from jaxbeam.model.state_space import state_space
from jaxbeam.simulation.record import Record, read_record
from jaxbeam.simulation.simulate import simulate
from jaxbeam.sweeps.sweep import sweep

__all__ = [
    "LQR",
    "MPC",
    "PD",
    "AugmentedLQR",
    "Beam",
    "Case",
    "DiscreteLQR",
    "Electrodynamic",
    "Feedback",
    "Filter",
    "FiniteLQR",
    "Inversion",
    "Kalman",
    "Lead",
    "MovingForce",
    "MovingMass",
    "Observer",
    "Passage",
    "Patch",
    "PointForce",
    "PositivePositionFeedback",
    "Prescribed",
    "Recognition",
    "Relief",
    "Record",
    "Run",
    "ScheduledFeedback",
    "ScheduledLQR",
    "Sensor",
    "Shaker",
    "SpringDamper",
    "StateFeedback",
    "StepLQR",
    "Support",
    "addresses",
    "bound",
    "load_case",
    "modes",
    "read_record",
    "recognised",
    "replace",
    "sampling_limit",
    "save_case",
    "simulate",
    "state_space",
    "sweep",
]
