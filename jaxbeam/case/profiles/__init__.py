"""Profiles of the surface: bumps, ramps, steps, sines, tables, and random ones by their spectra."""

from jaxbeam.case.profiles.shapes import (
    BumpProfile,
    RampProfile,
    SineProfile,
    StepProfile,
    TableProfile,
)
from jaxbeam.case.profiles.spectra import (
    ISO8608Profile,
    RailProfile,
    SpectrumProfile,
)

__all__ = [
    "BumpProfile",
    "ISO8608Profile",
    "RailProfile",
    "RampProfile",
    "SineProfile",
    "SpectrumProfile",
    "StepProfile",
    "TableProfile",
]
