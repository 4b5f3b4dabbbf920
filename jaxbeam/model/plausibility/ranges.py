"""The table of plausible ranges: what follows from the numbers of a case, and how large it may be.

Each row has one derived quantity, its range, and the likely mistake below and above it. Ranges hold
for models in a laboratory and for bridges: wide enough for both, narrow enough for a unit that is
wrong by a factor of a thousand.
"""

import math
from typing import NamedTuple

from jaxbeam.model.plausibility import values
from jaxbeam.model.plausibility.values import Values, of_beam, of_parts

INF = math.inf


class Range(NamedTuple):
    """Row of the table: values of a case, their range, and what is likely wrong outside.

    `says` is what the value means, in words with the value in it; the bound follows in the `unit`,
    if there is one. Of rows of one `cause` only the first that finds something speaks, of each part
    of a list; none speaks where one of the causes in `unless` has spoken, from which it may follow.
    """

    values: Values
    low: float
    high: float
    says: str
    below: str = ""
    above: str = ""
    unit: str = ""
    cause: str = ""
    unless: tuple[str, ...] = ()


STEEL = "Steel has 210e9 Pa and 7850 kg/m^3"

MATERIAL = (
    Range(
        of_beam("youngs_modulus"),
        1e6,
        2e12,
        "it is {value:.3g} Pa",
        f"is it in Pa, not in GPa or MPa? {STEEL}",
        f"is it in Pa? {STEEL}",
        cause="stiffness",
    ),
    Range(
        of_beam("density"),
        10.0,
        30e3,
        "it is {value:.3g} kg/m^3",
        f"is it in kg/m^3, not in t/m^3 or g/cm^3? {STEEL}",
        f"is it in kg/m^3, not a weight in N/m^3? {STEEL}",
        cause="stiffness",
    ),
    Range(
        of_beam("height", "width", over=values.length),
        1e-5,
        1.0,
        "it is {value:.3g} times the length of the beam",
        "is it in m, and is beam.length in m, not in mm?",
        "is it in m, not in mm, and is beam.length in m?",
        cause="stiffness",
    ),
)

WEIGHTS = (
    Range(
        values.gravity,
        0.5,
        30.0,
        "it is {value:.4g} m/s^2",
        "is it in m/s^2, 9.81 on earth, not in g?",
        "is it in m/s^2, 9.81 on earth, not in mm/s^2?",
        cause="weight",
    ),
    Range(
        values.weight_of_axle,
        0.0,
        600.0,
        "an axle presses with {value:.4g} kN",
        above="is it in {should}?",
        unit="kN",
        cause="weight",
    ),
    Range(
        values.weight_of_load,
        0.0,
        1500.0,
        "it presses with {value:.4g} kN",
        above="is it in {should}?",
        unit="kN",
        cause="weight",
    ),
    Range(
        values.mass_on_foot,
        0.0,
        300.0,
        "{value:.3g} kg move at {speed:.3g} m/s, as people walk",
        above="is it in kg, not a weight in N? {value:.3g} N are {people:.2g} kg",
        cause="weight",
    ),
    Range(
        of_parts("loads", "weight", kinds=("pedestrian", "crowd")),
        100.0,
        3000.0,
        "a person weighs {value:.3g} N",
        "is it in N, not in kg? 75 kg weigh 736 N",
        "is it that of one person in N?",
        unit="N",
        cause="weight",
    ),
    Range(
        values.mass_ratio,
        1e-5,
        10.0,
        "the loads on the beam have {value:.3g} times its mass",
        "are the loads in kg, not in t, and forces in N, not in kN?",
        "is {mass}, not in t, and are the loads in kg, forces in N?",
        cause="weight",
        unless=("stiffness",),
    ),
)

BEAM = (
    Range(
        values.slenderness,
        5.0,
        1e4,
        "the beam is {value:.3g} times as long as its radius of gyration, if it is solid",
        "is it in {unit}, is {mass}, not in t, and is beam.length in m?",
        "is it in {unit}, is beam.length in m, not in mm, and is {mass}?",
        cause="stiffness",
        unless=("weight",),
    ),
    Range(
        values.rigidity_over_shear,
        1e-8,
        1.0,
        "shear adds {value:.3g} times what E I / L^2 does to the flexibility",
        "is it kappa G A in N, and is beam.flexural_rigidity in N m^2?",
        "is it kappa G A in N, not in kN or MN?",
        cause="stiffness",
    ),
    Range(
        values.sag_of_loads,
        50.0,
        INF,
        "the beam sags by {sag:.4g} m under its loads, {share}",
        "is it in {unit}, and are masses of loads in kg, forces in N?",
        cause="stiffness",
    ),
    Range(
        values.rise_of_loads,
        0.0,
        1e6,
        "the beam sags by only {sag:.3g} m under its loads, {share}",
        above="are masses in kg, not in t, forces in N, not in kN, and is {stiffness} in {unit}?",
        cause="stiffness",
        unless=("weight",),
    ),
    Range(
        values.sag_of_beam,
        10.0,
        INF,
        "the beam sags by {sag:.4g} m under its own weight, {share}",
        "is it in {unit}, and is {mass}?",
        cause="stiffness",
        unless=("weight",),
    ),
    Range(
        values.first_frequency,
        0.01,
        1e4,
        "the first frequency is {value:.3g} Hz",
        "is it in {unit}, and is beam.length in m, not in mm?",
        "is it in {unit}, and is beam.length in m?",
        cause="stiffness",
        unless=("weight",),
    ),
    Range(
        values.damping_ratio,
        0.0,
        0.2,
        "the damping ratio is {value:.3g}",
        above="it is a fraction of critical damping: 0.01 for one per cent",
    ),
    Range(
        values.radius_of_rotary_inertia,
        0.0,
        0.5,
        "the radius of gyration of a section is {value:.3g} times the length of the beam",
        above="is it rho I in kg m, and beam.mass_per_length in kg/m, not in t/m?",
    ),
    Range(
        values.step_of_segments,
        0.0,
        3e3,
        "it is {value:.3g} times as large, or as small, as that of the segment before",
        above="are all segments in the same unit, N m^2 and kg/m?",
    ),
    Range(
        values.rigid_motions,
        0.0,
        0.0,
        "the beam is a mechanism: nothing resists {value:.0f} of its motions, so that it falls",
        above="{remedy} [[supports]]",
    ),
    Range(
        values.settlement,
        0.0,
        0.01,
        "the support settles by {drop:.4g} m, {value:.2g} times the length of the beam",
        above="is it in m, not in mm?",
    ),
    Range(
        values.clamping_distance,
        0.01,
        INF,
        "{first} and {second} are only {apart:.3g} m apart, and clamp the beam",
        "are positions in m? Leave one out, or clamp the end",
    ),
)

ABSORBERS = (
    Range(
        of_parts("absorbers", "mass", "inertance", over=values.mass),
        0.0,
        2.0,
        "it is {value:.3g} times the mass of the beam",
        above="is it in kg, and beam.mass_per_length in kg/m, not in t/m?",
        unless=("weight",),
    ),
    Range(
        values.mass_of_absorber,
        1e-4,
        INF,
        "it is {value:.2g} times the mass of the beam, and changes nothing",
        "is it in kg, not in t?",
        unless=("weight",),
    ),
    Range(
        values.absorber_over_first_frequency,
        0.1,
        INF,
        "the absorber swings at {frequency:.3g} Hz, {value:.2g} times the first frequency of the"
        " beam",
        "is it in N/m, not in kN/m? Or give its frequency",
        cause="absorber",
        unless=("stiffness", "weight"),
    ),
    Range(
        values.damping_of_absorber,
        1e-3,
        2.0,
        "the damping ratio of the absorber is {value:.2g}",
        "is it {unit}?",
        "is it {unit}?",
        unless=("weight", "absorber"),
    ),
    Range(
        values.support_over_bending,
        1e-4,
        INF,
        "it is {value:.2g} times the stiffness of the beam in bending, and changes nothing",
        "is it in N/m, not in kN/m or MN/m?",
        unless=("stiffness",),
    ),
    Range(
        values.foundation_over_bending,
        1e-4,
        INF,
        "it is {value:.2g} times the stiffness of the beam in bending, and changes nothing",
        "is it in N/m^2, not in kN/m^2 or MN/m^2?",
        unless=("stiffness",),
    ),
)

ACTUATORS = (
    Range(
        values.influence_of_actuator,
        1e-3,
        INF,
        "the actuator at {x:.4g} m is on a support, where it moves nothing",
        "is it in m from the left end? Move it into a span",
        cause="command",
    ),
    Range(
        values.least_command,
        0.0,
        0.0,
        "commands from {low:.4g} to {high:.4g} {unit} exclude 0, so that it is never at rest",
        above="are they the smallest and the largest command, as [-{size:.4g}, {size:.4g}]?",
    ),
    Range(
        of_parts("actuators", "d33"),
        1e-13,
        1e-8,
        "it is {value:.3g} m/V",
        "is it in m/V? Piezoceramics have some 4e-10 m/V",
        "is it in m/V, not in pm/V or nm/V? Piezoceramics have some 4e-10 m/V",
        cause="command",
    ),
    Range(
        of_parts("actuators", "modulus"),
        1e8,
        1e12,
        "Young's modulus of the patch is {value:.3g} Pa",
        "is it in Pa, not in GPa or MPa? Fibre patches have some 30e9 Pa",
        "is it in Pa? Fibre patches have some 30e9 Pa",
        cause="command",
    ),
    Range(
        of_parts("actuators", "electrode_spacing"),
        1e-6,
        0.02,
        "electrodes are {value:.3g} m apart",
        "is it in m? Fibre patches have some 0.5e-3 m",
        "is it in m, not in mm? Fibre patches have some 0.5e-3 m",
        cause="command",
    ),
    Range(
        of_parts("actuators", "beam_height", "patch_height", "patch_width", over=values.length),
        1e-7,
        0.3,
        "it is {value:.3g} times the length of the beam",
        "is it in m?",
        "is it in m, not in mm?",
        cause="command",
    ),
    Range(
        of_parts("actuators", "correction"),
        0.01,
        3.0,
        "{value:.3g} times the moment of the patch reaches the beam",
        "it is a fraction, 0.8 for 80 per cent",
        "it is a fraction, 0.8 for 80 per cent",
        cause="command",
    ),
    Range(
        values.sag_of_command,
        1e-9,
        0.1,
        "the largest command bends the beam by {sag:.3g} m, {value:.2g} times its length",
        "is it in {unit}, and are limits those of the command?",
        "is it in {unit}, and are limits those of the command, before any amplifier?",
        cause="command",
        unless=("stiffness",),
    ),
    Range(
        of_parts("actuators", "added_rigidity", over=values.rigidity),
        0.0,
        30.0,
        "the patch is {value:.3g} times as stiff as the beam",
        above="is it E I in N m^2, as that of the beam?",
    ),
    Range(
        of_parts("actuators", "added_mass", over=values.density),
        0.0,
        30.0,
        "it is {value:.3g} times the mass per length of the beam",
        above="is it in kg/m, not in g/m, and not the mass of the whole patch?",
    ),
    Range(
        values.lag_of_actuator,
        0.3,
        INF,
        "the actuator lags behind commands at {value:.2g} times the first frequency of the beam",
        "is it in 1/s, 2 pi times the frequency in Hz, not in kHz?",
        unless=("stiffness",),
    ),
    Range(
        values.growth_of_inner_loops,
        -INF,
        0.0,
        "the beam with it is unstable without any controller, and grows as exp({value:.3g} t / s)"
        " at {hertz:.3g} Hz",
        above="lower the bandwidth or the gains of the loop, or raise its sensor_bandwidth",
    ),
)

LOADS = (
    Range(
        values.sag_of_spring,
        0.0,
        1.5,
        "the spring gives by {value:.3g} m under the weight that it carries",
        above="is it in N/m, not in kN/m, and are masses in kg?",
        unit="m",
        cause="spring",
    ),
    Range(
        values.stage_damping,
        5e-4,
        5.0,
        "with its spring and mass its damping ratio is {value:.2g}",
        "is it in N s/m, not in kN s/m?",
        "is it in N s/m, and are springs in N/m, not in kN/m?",
        cause="spring",
    ),
    Range(
        values.tyre_over_suspension_stiffness,
        0.7,
        INF,
        "the suspension is stiffer than the tyre, which has {value:.2g} times its stiffness",
        "is it swapped with {other}?",
        unless=("spring",),
    ),
    Range(
        values.tyre_over_suspension_damping,
        0.0,
        3.0,
        "the tyre has {value:.2g} times the damping of the suspension",
        above="is it swapped with {other}?",
        unless=("spring",),
    ),
    Range(
        values.primary_over_secondary_stiffness,
        0.5,
        INF,
        "the primary springs of a bogie have {value:.2g} times the stiffness of the secondary one",
        "is it swapped with {other}?",
        unless=("spring",),
    ),
    Range(
        values.unsprung_over_sprung,
        2e-3,
        1.0,
        "what is below the suspension has {value:.3g} times the mass of the body",
        "are both in kg, not in t?",
        above="is it swapped with {upper}, and are both in kg?",
    ),
    Range(
        values.distance_of_axles,
        0.2,
        200.0,
        "axles are up to {value:.3g} m apart",
        "are distances in m?",
        "are distances in m, not in mm?",
        unit="m",
        cause="distance",
    ),
    Range(
        values.gyration_over_wheelbase,
        0.1,
        5.0,
        "the radius of gyration in pitch is {value:.2g} times half the wheelbase",
        "is it in kg m^2, not in t m^2, and are distances in m?",
        "is it in kg m^2, are masses in kg, not in t, and distances in m?",
        unless=("distance",),
    ),
    Range(
        values.weight_over_force,
        0.0,
        3.0,
        "the masses weigh {value:.3g} times what the axles press with",
        above="are they in kg, the unsprung part, and are forces in N, not in kN?",
    ),
    Range(
        of_parts("loads", "pace", kinds=("pedestrian", "crowd")),
        0.5,
        5.0,
        "a person takes {value:.3g} steps a second",
        "is it in Hz, not the time of a step in s?",
        "is it in Hz, not in rad/s or steps a minute?",
    ),
    Range(
        of_parts("loads", "speed", kinds=("pedestrian", "crowd")),
        0.2,
        12.0,
        "a person moves at {value:.3g} m/s",
        "is it in m/s?",
        "is it in m/s, not in km/h?",
        cause="speed",
    ),
    Range(
        of_parts("loads", "factors", kinds=("pedestrian", "crowd")),
        0.0,
        3.0,
        "it is {value:.3g} times the weight",
        above="it is a fraction, 0.4 for 40 per cent",
    ),
    Range(
        of_parts("loads", "start_position", over=values.length),
        0.0,
        1000.0,
        "it starts {value:.3g} lengths of the beam away from it",
        above="is it in m, not in mm?",
        cause="travel",
    ),
    Range(
        values.entry_over_duration,
        -INF,
        1 - 1e-12,
        "it never enters the beam, {when}, and the run ends at {duration:.4g} s (run.duration)",
        above="{likely}",
        cause="travel",
    ),
    Range(
        values.braking_to_stop,
        0.0,
        0.0,
        "{braking:.4g} m/s^2 stop the load on the beam, at {x:.4g} m; less than {need:.3g} m/s^2"
        " let it leave",
        above="is it in m/s^2? Give times and positions of a load that is to stay",
        cause="travel",
    ),
    Range(
        values.exit_over_duration,
        -INF,
        1 + 1e-12,
        "it has not left the beam by the end of the run at {duration:.4g} s",
        above="it leaves at t = {leave:.4g} s; {likely}",
        cause="travel",
        unless=("stiffness", "distance"),
    ),
    Range(
        values.speed_over_traffic,
        0.0,
        1.0,
        "{speed:.4g} m/s is {kmh:.4g} km/h, faster than any {traffic}",
        above="is it {unit}?",
        cause="speed",
    ),
    Range(
        values.speed_ratio,
        0.0,
        1.0,
        "{speed:.4g} m/s is {kmh:.4g} km/h, faster than the critical speed of {critical:.4g} m/s",
        above="is it {unit}?",
        cause="speed",
        unless=("stiffness",),
    ),
    Range(
        values.largest_phase,
        0.0,
        4 * math.pi + 1e-9,
        "the phase is {value:.4g} rad",
        above="is it in rad, not in degrees?",
    ),
)

OTHERS = (
    Range(
        values.height_of_profile,
        0.0,
        0.1,
        "the profile rises and falls by {height:.3g} m, {value:.2g} times the length of the beam",
        above="{should}",
        cause="profile",
    ),
    Range(
        values.rise_of_waves,
        0.0,
        0.3,
        "the surface rises and falls by {value:.3g} m",
        above="is it in m, not in mm?",
        unit="m",
        cause="profile",
    ),
    Range(
        values.slope_of_profile,
        0.0,
        1.0,
        "the profile is as steep as {value:.3g}",
        above="{should}",
        cause="profile",
    ),
    Range(
        of_parts("profile", "wavelength", "contact_length", over=values.length),
        0.0,
        200.0,
        "it is {value:.3g} times the length of the beam",
        above="is it in m, not in mm?",
        cause="profile",
    ),
    Range(
        values.cutoff_over_crossing,
        0.2,
        INF,
        "{cutoff:.3g} Hz let nothing through of loads that leave within {last:.3g} s",
        "is it in Hz, not in kHz?",
    ),
    Range(
        of_parts("sensors", "fibre_distance", over=values.length),
        0.0,
        0.25,
        "the gauge is {value:.3g} lengths of the beam off its axis",
        above="is it in m, not in mm?",
    ),
    Range(
        values.size_of_section_modulus,
        0.0,
        0.15,
        "it is that of a section some {side:.3g} m high",
        above="is it in m^3, not in cm^3 or mm^3?",
    ),
    Range(
        values.error_over_reading,
        0.0,
        1.0,
        "{given:.3g} {unit} exceed the readings, which are of some {size:.2g} {unit}",
        above="is it in {unit}, not in {small}?",
        unless=("stiffness", "weight"),
    ),
    Range(
        values.sides_of_jumps,
        0.0,
        0.0,
        "the {quantity} jumps at {name}, at {x:.4g} m, and the sensor reads it to the right of it",
        above='write side = "right" if that is meant, "left" for the other side',
    ),
    Range(
        values.delay_over_duration,
        0.0,
        1.0,
        "{delay:.4g} s are longer than the run of {duration:.4g} s",
        above="is it in s, not in ms?",
        cause="delay",
    ),
    Range(
        values.delay_over_period,
        0.0,
        5.0,
        "the delay is {value:.3g} periods of the first mode",
        above="is it in s, not in ms?",
        cause="delay",
        unless=("stiffness",),
    ),
    Range(
        values.samples_in_period,
        2.0,
        INF,
        "the controller takes {value:.2g} samples in a period of mode {mode} ({frequency:.3g} Hz)",
        "is it in s, not in ms or the rate in Hz? It should be below {longest:.2g} s",
        unless=("stiffness",),
    ),
    Range(
        values.samples_of_record,
        values.LEAST_SAMPLES,
        INF,
        "{rate:.4g} Hz make {value:.2g} samples in a period of {what} at {frequency:.4g} Hz",
        "{likely}",
        unless=("stiffness",),
    ),
    Range(
        values.samples_of_force,
        values.LEAST_SAMPLES,
        INF,
        "{rate:.4g} Hz make {value:.2g} samples in a period of the force at {frequency:.4g} Hz",
        "is it in Hz, not in rad/s? Else give a run.sample_rate above {least:.3g} Hz",
    ),
    Range(
        values.duration_over_crossing,
        0.0,
        300.0,
        "the run of {duration:.4g} s is {value:.3g} times as long as its loads need to leave"
        " ({last:.3g} s)",
        above="is it in s, not in ms?",
    ),
)

ADVICE = (  # on what commands report
    Range(
        values.sensor_count,
        1.0,
        INF,
        "there are none, so that only contact forces are reported",
        "write [[sensors]] with a position",
    ),
)

RANGES = (*MATERIAL, *WEIGHTS, *BEAM, *ABSORBERS, *ACTUATORS, *LOADS, *OTHERS)
