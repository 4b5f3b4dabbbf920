"""Beam and controller as FMI 3.0 units for co-simulation, and their steps."""

from jaxbeam.fmi.steps import BeamSteps, ControllerSteps
from jaxbeam.fmi.units import PARTS, write_fmu

__all__ = ["PARTS", "BeamSteps", "ControllerSteps", "write_fmu"]
