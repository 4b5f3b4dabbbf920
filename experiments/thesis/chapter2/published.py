"""Chapter 2: modes, critical speeds, moving force and mass, shaker, patches."""

from experiments.thesis.verdicts import FORMULA, HZ, PublishedNumbers

RIG_A, RIG_B, RIG_D = "rig A, chapter 2", "rig B, chapter 2", "rig D, chapter 2"
RIG_A_CONTROLLED = "rig A, chapter 5"
TWO_SPANS = "two spans of the beam of rig A, chapter 2"
MODE_LABELS = "1 2 3 4 5 6 7 8"

# Modes and critical speeds.
FREQUENCY_PARAMETERS = PublishedNumbers(
    "Table 2.1",
    "frequency parameters of two equal spans",
    "1",
    "3.1416 3.9266 6.2832 7.0686 9.4248 10.2102 12.5664 13.3518",
    MODE_LABELS,
    rig=TWO_SPANS,
)
ANALYTICAL_FREQUENCIES = PublishedNumbers(
    "Table 2.2",
    "natural frequencies, analytical",
    HZ,
    "20.387 31.849 81.550 103.212 183.488 215.343 326.2 368.249",
    MODE_LABELS,
    tolerance=FORMULA,
    interpretation="12.11 N m^2 and 0.5411 kg/m, as beside the table",
    repeats="Table 2.1, squared, times one factor",
    repeated_labels="2 3 4 5 6 7 8",
    rig=TWO_SPANS,
)
APPROXIMATE_FREQUENCIES = PublishedNumbers(
    "Table 2.2",
    "natural frequencies, approximate",
    HZ,
    "20.387 31.951 81.550 104.304 183.487 220.577 326.198 100660",
    MODE_LABELS,
    tolerance=FORMULA,
    interpretation="a rigid support as a spring in eight sine modes",
    repeats="the row above it",
    repeated_labels="1 3 5 7",
    rig=TWO_SPANS,
)
FREQUENCY_ERRORS = PublishedNumbers(
    "Table 2.2",
    "error of the approximate frequencies",
    "%",
    "0.322 1.06 2.43 273240",
    "2 4 6 8",
    repeats="the two rows above it, by division (27235 % for the last)",
    rig=TWO_SPANS,
)
CRITICAL_SPEED = PublishedNumbers(
    "2.3",
    "critical speed of one span, eq. (2.38)",
    "m/s",
    "24.03",
    "one-span",
    tolerance=FORMULA,
    rig=RIG_A,
)
TWO_SPAN_CRITICAL_SPEEDS = PublishedNumbers(
    "2.3",
    "critical speeds of two spans, eqs (2.38) and (2.39)",
    "m/s",
    "48.95 38.24",
    "1st 2nd",
    tolerance=FORMULA,
    repeats="the frequencies of Table 2.2, times a length",
    rig=TWO_SPANS,
)
SPEED_RATIOS = PublishedNumbers(
    "2.3",
    "speed over critical speed",
    "1",
    "0.04 0.04 0.08",
    "0.9m/s,one-span 1.5m/s,two-spans 3m/s,two-spans",
    interpretation="v_cr2 for two spans",
    repeats="the critical speeds, by division",
    rig=RIG_A,
)
ANGULAR_FREQUENCIES = PublishedNumbers(
    "2.3",
    "angular frequencies of two spans",
    "rad/s",
    "128 200.22",
    "1 2",
    tolerance=FORMULA,
    repeats="the critical speeds of two spans, by eqs (2.38) and (2.39)",
    rig=TWO_SPANS,
)
MASS_RATIO = PublishedNumbers(
    "Fig. 2.25",
    "mass over mass of the beam",
    "1",
    "0.81 1.56",
    "0.26kg 0.5kg",
    repeats="the masses, over the mass of the beam",
    rig=RIG_A,
)
SHAKER_MODES = PublishedNumbers(
    "5.1",
    "natural frequencies with the shaker",
    HZ,
    "24 72 159",
    "1 2 3",
    interpretation="stiffness of the shaker not stated there; 3500 N/m as where it is active",
    rig=RIG_A_CONTROLLED,
)

# Patches and sections.
PATCH_MOMENT = PublishedNumbers(
    "2.4.2",
    "C0 of the patch, eq. (2.43)",
    "N m/V",
    "8.292e-4",
    repeats="the dimensions printed beside it, by eq. (2.43)",
    rig=RIG_B,
)
PATCH_SECTION = PublishedNumbers(
    "2.4.2",
    "rigidity of the beam with a patch",
    "N m^2",
    "13.211",
    interpretation="h = 2.83 mm as printed beside it; 65 GPa",
    repeats="the printed mass per length, by the section of 2.9 mm that both belong to",
    rig=RIG_B,
)

# Moving force and moving mass.
FREE_AMPLITUDE_RATIO = PublishedNumbers(
    "Fig. 2.23",
    "free amplitude, moving force over moving mass",
    "1",
    "3",
    interpretation="up to three times",
    rig=RIG_D,
)
FREE_PHASE_DIFFERENCE = PublishedNumbers(
    "Fig. 2.23", "phase between both free vibrations", "degree", "180", rig=RIG_D
)
FORCE_MASS_DIFFERENCE = PublishedNumbers(
    "Fig. 2.24",
    "peaks of moving force and mass differ by",
    "mm",
    "0.04",
    interpretation="the prescribed voltage is not printed",
    rig=RIG_A,
)
ONE_SPAN_AMPLIFICATION = PublishedNumbers(
    "Fig. 2.25",
    "amplification at midspan of one span",
    "1",
    "1.6 2.0 2.2",
    "force,0.7 0.26kg,0.5 0.5kg,0.75",
    interpretation="at the speed ratio v / v_cr, without the shaker",
    rig=RIG_A,
)
TWO_SPAN_AMPLIFICATION = PublishedNumbers(
    "Fig. 2.27",
    "amplification on two spans, moving mass of 0.261 kg",
    "1",
    "3.6 4.5 5",
    "1st-midspan,0.45 2nd-midspan,0.45 2nd-midspan,1.75",
    interpretation="at the speed ratio v / v_cr1",
    rig=TWO_SPANS,
)
YANG_AMPLIFICATION = PublishedNumbers(
    "2.3",
    "amplification of a moving force, after Yang",
    "1",
    "1.5 3.25",
    "1st-midspan 2nd-midspan",
    interpretation="largest over the speed, undamped; first span as Yang's simply supported beam",
    rig=TWO_SPANS,
)

# Frequency responses with the electrodynamic shaker.
FORCE_DROPS = PublishedNumbers(
    "Fig. 2.15", "force drops of force per voltage", HZ, "21 84 189 340", "1 2 3 4", rig=RIG_A
)
SHAKER_GAIN = PublishedNumbers(
    "Fig. 2.15",
    "force per voltage below 11 Hz and at its peak",
    "N/V",
    "2.5 10",
    "low peak",
    rig=RIG_A,
)
SHAKER_PEAK_FREQUENCY = PublishedNumbers("Fig. 2.15", "the peak is at", HZ, "27", rig=RIG_A)
TRANSMITTED_PEAK_FREQUENCY = PublishedNumbers(
    "Fig. 2.18", "peak of the force on the beam per coil force", HZ, "27", rig=RIG_A
)
STATIONARY_MASS_DROP = PublishedNumbers(
    "Fig. 2.16", "further force drop with 0.5 kg at 0.3 m", HZ, "13", rig=RIG_A
)
STATIONARY_MASS_PEAK = PublishedNumbers(
    "Fig. 2.16", "peak with 0.5 kg at 0.3 m", "N/V", "32.5", rig=RIG_A
)
STATIONARY_MASS_PEAK_FREQUENCY = PublishedNumbers(
    "Fig. 2.16", "the peak with 0.5 kg at 0.3 m is at", HZ, "27", rig=RIG_A
)
