"""One profile of every kind, with and without a contact patch."""

import jaxbeam as jb

POSITIONS = [-3.0, -1.0, 0.5, 1.0, 2.5, 4.0, 7.0]
HEIGHTS = [0.0, 2e-3, -1e-3, 1e-3, 4e-3, 3e-3, 5e-3]

# The waves of random profiles are few, so that tests are quick.
PLAIN = {
    "table": jb.profiles.TableProfile(POSITIONS, HEIGHTS),
    "sine": jb.profiles.SineProfile(amplitude=5e-3, wavelength=3.0, phase=0.4),
    "ramp": jb.profiles.RampProfile(start=1.0, end=3.0, height=0.01),
    "step": jb.profiles.StepProfile(start=1.0, end=3.0, height=-0.01),
    "bump": jb.profiles.BumpProfile(start=1.0, end=3.0, height=0.02),
    "spectrum": jb.profiles.SpectrumProfile([0.1, 0.35, 1.2], [4e-3, 2e-3, 1e-4], [0.3, 2.0, 5.0]),
    "iso8608": jb.profiles.ISO8608Profile("C", seed=4, waves=12, switch_on=[-2.0, 3.0]),
    "rail": jb.profiles.RailProfile("fra-3", seed=2, waves=12, switch_on=[6.0, 1.0]),
}
AVERAGED = {
    "table": jb.profiles.TableProfile(POSITIONS, HEIGHTS, contact_length=0.7),
    "sine": jb.profiles.SineProfile(5e-3, 3.0, 0.4, contact_length=0.7),
    "ramp": jb.profiles.RampProfile(1.0, 3.0, 0.01, contact_length=0.7),
    "step": jb.profiles.StepProfile(1.0, 3.0, -0.01, contact_length=0.7),
    "bump": jb.profiles.BumpProfile(1.0, 3.0, 0.02, contact_length=0.7),
    "spectrum": jb.profiles.SpectrumProfile(
        [0.1, 0.35, 1.2], [4e-3, 2e-3, 1e-4], [0.3, 2.0, 5.0], contact_length=0.7
    ),
    "iso8608": jb.profiles.ISO8608Profile(
        "C", 4, waves=12, switch_on=[-2.0, 3.0], contact_length=0.7
    ),
    "rail": jb.profiles.RailProfile("fra-3", 2, waves=12, switch_on=[6.0, 1.0], contact_length=0.7),
}
PROFILES = PLAIN | {f"{kind}, contact patch": profile for kind, profile in AVERAGED.items()}
