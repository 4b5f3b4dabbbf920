"""Every printed number of the thesis that a computation can be held against.

Facts only: the numbers as printed, where, their unit, whether they were measured or computed, and
how near ours must come. The tolerances follow from the kind of number and were chosen before any
of the experiments was run; what else explains a number is in its experiment. Not listed, because
nothing here bears on them: times that the author's computer took (Figs 7.4, 7.8), measured
velocities (Fig. 5.22), and curves without a number.

The thesis: "Active structural control of single and multi-span beam structures subjected to
transient loads", Liverpool John Moores University. Its measured curves are not available.
"""

from experiments.verdicts import Printed, Tolerance

EXACT = Tolerance("a table of an eigenvalue problem that is stated in full", digits=1)
FORMULA = Tolerance("a formula with its numbers", relative=0.001)
SAME_MODEL = Tolerance("computed with a model that is stated in full", relative=0.02)
CURVE = Tolerance("read off a computed curve, and rounded in the text", relative=0.05)
SAMPLE = Tolerance("an instant of a sampled run, to one sample", absolute=0.01)
POINTS = Tolerance("a computed reduction in percent, to one point", absolute=1.0)
MEASURED = Tolerance("measured; supports alone are quoted to yield by 0.1 mm", relative=0.05)
RUNS = Tolerance("a measured reduction, mean of few runs, to three points", absolute=3.0)
VOLTS = Tolerance("a measured voltage", relative=0.1)

HZ, EIGHT = "Hz", "1 2 3 4 5 6 7 8"

# Chapter 2: modes and critical speeds.
LAMBDAS = Printed(
    "Table 2.1",
    "frequency parameters of two equal spans",
    "1",
    "computed",
    EXACT,
    "3.1416 3.9266 6.2832 7.0686 9.4248 10.2102 12.5664 13.3518",
    EIGHT,
)
ANALYTICAL = Printed(
    "Table 2.2",
    "natural frequencies, analytical",
    HZ,
    "computed",
    EXACT,
    "20.387 31.849 81.550 103.212 183.488 215.343 326.2 368.249",
    EIGHT,
    "12.11 N m^2 and 0.5411 kg/m stand beside the table",
)
APPROXIMATE = Printed(
    "Table 2.2",
    "natural frequencies, approximate",
    HZ,
    "computed",
    EXACT,
    "20.387 31.951 81.550 104.304 183.487 220.577 326.198 100660",
    EIGHT,
    "a rigid support as a spring in eight sine modes",
)
ERRORS = Printed(
    "Table 2.2",
    "error of the approximate frequencies",
    "%",
    "computed",
    EXACT,
    "0.322 1.06 2.43 273240",
    "2 4 6 8",
)
CRITICAL = Printed(
    "2.3",
    "critical speeds, eqs (2.38) and (2.39)",
    "m/s",
    "computed",
    FORMULA,
    "24.03 48.95 38.24",
    "one-span two-spans,1st two-spans,2nd",
)
SPEED_RATIOS = Printed(
    "2.3",
    "speed over critical speed",
    "1",
    "computed",
    EXACT,
    "0.04 0.04 0.08",
    "0.9m/s,one-span 1.5m/s,two-spans 3m/s,two-spans",
    "v_cr2 for two spans",
)
ANGULAR = Printed(
    "2.3",
    "angular frequencies of two spans",
    "rad/s",
    "computed",
    FORMULA,
    "128 200.22",
    "1 2",
)
MASS_RATIO = Printed(
    "Fig. 2.25", "mass over mass of the beam", "1", "computed", EXACT, "0.81 1.56", "0.26kg 0.5kg"
)
SHAKER_MODES = Printed(
    "5.1",
    "natural frequencies with the shaker",
    HZ,
    "computed",
    SAME_MODEL,
    "24 72 159",
    "1 2 3",
    "the stiffness of the shaker is not named there; 3500 N/m where it is active",
)

# Chapter 2: patches and sections.
MOMENT = Printed("2.4.2", "C0 of the patch, eq. (2.43)", "N m/V", "computed", FORMULA, "8.292e-4")
SECTION = Printed(
    "2.4.2",
    "rigidity (N m^2) and mass per length (kg/m)",
    "",
    "computed",
    FORMULA,
    "13.211 0.812",
    "EI rhoA",
    "h = 2.83 mm stands beside it; 65 GPa, 2800 kg/m^3",
)
CUTOFF = Printed("2.2.3", "cutoff of the first-order shaker", HZ, "computed", FORMULA, "1591.5")

# Chapter 2: moving force and moving mass.
FREE_RATIO = Printed(
    "Fig. 2.23",
    "free amplitude, moving force over moving mass",
    "1",
    "computed",
    CURVE,
    "3",
    "",
    "up to three times",
)
FREE_PHASE = Printed(
    "Fig. 2.23",
    "phase between both free vibrations",
    "degree",
    "computed",
    CURVE,
    "180",
)
FORCE_LESS = Printed(
    "Fig. 2.24",
    "peaks of moving force and mass differ by",
    "mm",
    "computed",
    Tolerance("a difference read off a curve, to one digit", digits=1),
    "0.04",
    "",
    "the prescribed voltage is not printed",
)
ONE_SPAN = Printed(
    "Fig. 2.25",
    "amplification at midspan of one span",
    "1",
    "computed",
    CURVE,
    "1.6 2.0 2.2",
    "force,0.7 0.26kg,0.5 0.5kg,0.75",
    "at the speed ratio v / v_cr, without the shaker",
)
TWO_SPANS = Printed(
    "Fig. 2.27",
    "amplification on two spans, moving mass of 0.261 kg",
    "1",
    "computed",
    CURVE,
    "3.6 4.5 5",
    "1st-midspan,0.45 2nd-midspan,0.45 2nd-midspan,1.75",
    "at the speed ratio v / v_cr1",
)
YANG = Printed(
    "2.3",
    "amplification of a moving force, after Yang",
    "1",
    "computed",
    CURVE,
    "1.5 3.25",
    "1st-midspan 2nd-midspan",
    "largest over the speed, undamped; first span as Yang's simply supported beam",
)

# Chapter 2: frequency responses with the electrodynamic shaker.
DROPS = Printed(
    "Fig. 2.15",
    "force drops of force per voltage",
    HZ,
    "computed",
    CURVE,
    "21 84 189 340",
    "1 2 3 4",
)
SHAKER_GAIN = Printed(
    "Fig. 2.15",
    "force per voltage below 11 Hz and at its peak",
    "N/V",
    "computed",
    CURVE,
    "2.5 10",
    "low peak",
)
SHAKER_PEAK = Printed("Fig. 2.15", "the peak is at", HZ, "computed", CURVE, "27")
TRANSMITTED_PEAK = Printed(
    "Fig. 2.18", "peak of the force on the beam per coil force", HZ, "computed", CURVE, "27"
)
PARKED_DROP = Printed(
    "Fig. 2.16", "further force drop with 0.5 kg at 0.3 m", HZ, "computed", CURVE, "13"
)
PARKED_PEAK = Printed("Fig. 2.16", "peak with 0.5 kg at 0.3 m", "N/V", "computed", CURVE, "32.5")
PARKED_PLACE = Printed(
    "Fig. 2.16", "the peak with 0.5 kg at 0.3 m is at", HZ, "computed", CURVE, "27"
)

# Chapter 6: displacement feedback, masses m1 to m4.
FOUR = "m1 m2 m3 m4"
FREE_S1 = Printed(
    "Table 6.1", "s1, no control", "mm", "measured", MEASURED, "0.676 0.833 0.959 1.331", FOUR
)
CUBIC_S1 = Printed(
    "Table 6.1", "s1, cubic", "mm", "measured", MEASURED, "0.653 0.782 0.895 1.160", FOUR
)
CUBIC_LESS_S1 = Printed(
    "Table 6.1", "s1, less by cubic", "%", "measured", RUNS, "3.40 6.12 6.67 12.84", FOUR
)
LINEAR_S1 = Printed(
    "Table 6.1", "s1, linear", "mm", "computed", SAME_MODEL, "0.605 0.752 0.8607 1.196", FOUR
)
LINEAR_LESS_S1 = Printed(
    "Table 6.1", "s1, less by linear", "%", "computed", POINTS, "10.51 9.72 10.25 10.14", FOUR
)
FREE_S3 = Printed(
    "Table 6.2", "s3, no control", "mm", "measured", MEASURED, "0.701 0.873 0.997 1.383", FOUR
)
FREE_S3_COMPUTED = Printed(
    "Table 6.2", "s3, no control", "mm", "computed", SAME_MODEL, "0.669 0.836 0.959 1.320", FOUR
)
CUBIC_S3 = Printed(
    "Table 6.2", "s3, cubic", "mm", "measured", MEASURED, "0.683 0.816 0.917 1.200", FOUR
)
CUBIC_LESS_S3 = Printed(
    "Table 6.2", "s3, less by cubic", "%", "measured", RUNS, "2.56 6.53 8.02 13.23", FOUR
)
LINEAR_S3 = Printed(
    "Table 6.2", "s3, linear", "mm", "computed", SAME_MODEL, "0.607 0.755 0.864 1.188", FOUR
)
LINEAR_LESS_S3 = Printed(
    "Table 6.2", "s3, less by linear", "%", "computed", POINTS, "9.26 9.67 9.91 10", FOUR
)
FREE_UP = Printed(
    "Table 6.3",
    "s3 upwards, no control",
    "mm",
    "measured",
    MEASURED,
    "0.277 0.338 0.394 0.536",
    FOUR,
)
CUBIC_UP = Printed(
    "Table 6.3", "s3 upwards, cubic", "mm", "measured", MEASURED, "0.264 0.322 0.377 0.489", FOUR
)
CUBIC_LESS_UP = Printed(
    "Table 6.3", "s3 upwards, less by cubic", "%", "measured", RUNS, "4.69 4.73 4.31 8.77", FOUR
)
FEEDBACK_VOLTS = Printed(
    "Fig. 6.9", "largest voltage at a patch", "V", "measured", VOLTS, "111 680", "m1,span1 m4,span2"
)
TWO_MASSES = Printed("Fig. 6.11", "s3, less by cubic for two masses", "%", "measured", RUNS, "10.5")
UNSTABLE_MASS = Printed(
    "Fig. 6.10",
    "two spans, lightest mass with which the cubic law of k = 3 is unstable",
    "kg",
    "measured",
    FORMULA,
    "0.322",
    reading="of the masses tried; unstable is what drives the commands to their limits",
)
SWITCHED_MASSES = Printed(
    "Fig. 6.7",
    "one span, masses from which cubic k = 2 beats linear k = 2 and 3",
    "kg",
    "computed",
    CURVE,
    "0.345 0.45",
    "k2 k3",
)
LAST_GAIN = Printed(
    "Fig. 6.7", "one span, linear gain as good as cubic k = 2", "V/mm", "computed", CURVE, "3.6"
)
ONE_SPAN_LINEAR = Printed(
    "Fig. 6.6",
    "one span, less by linear, least and most",
    "%",
    "measured",
    RUNS,
    "9 11",
    "least most",
)
ONE_SPAN_CUBIC = Printed(
    "Fig. 6.6",
    "one span, less by cubic, least and most",
    "%",
    "measured",
    RUNS,
    "5.5 18.5",
    "least most",
)
AFTER_EXIT = Printed("6.1", "one span, vibration after the exit", HZ, "measured", CURVE, "17")
SUMMARY_ONE = Printed(
    "Table 8.1",
    "one span, 0.509 kg, less by feedback",
    "%",
    "measured",
    RUNS,
    "11 18",
    "linear cubic",
)
SUMMARY_TWO = Printed(
    "Table 8.1",
    "two spans, 0.509 kg, less by feedback",
    "%",
    "measured",
    RUNS,
    "10 13",
    "linear cubic",
)

# Chapter 5: optimal control of one span with a shaker, peaks at 0.25 m in percent of no control.
THREE = "0.261kg 0.371kg 0.509kg"
INVARIANT_SLOW = Printed(
    "Table 5.1", "time-invariant, 0.3 m/s", "%", "measured", RUNS, "96.9 97.7 96.6", THREE
)
VARYING_SLOW = Printed(
    "Tables 5.1, 5.3", "time-varying, 0.3 m/s", "%", "measured", RUNS, "88 85.7 83.2", THREE
)
INVARIANT_FAST = Printed(
    "Table 5.2", "time-invariant, 0.55 m/s", "%", "measured", RUNS, "99.2 97.1 92", THREE
)
VARYING_FAST = Printed(
    "Tables 5.2, 5.4", "time-varying, 0.55 m/s", "%", "measured", RUNS, "87.2 83 82.1", THREE
)
AUGMENTED_SLOW = Printed(
    "Table 5.3", "augmented, 0.3 m/s", "%", "measured", RUNS, "67.12 67.85 66.29", THREE
)
AUGMENTED_FAST = Printed(
    "Table 5.4", "augmented, 0.55 m/s", "%", "measured", RUNS, "62.83 61.82 62.43", THREE
)
SUMMARY_OPTIMAL = Printed(
    "Table 8.1",
    "one span, 0.509 kg, less by optimal control",
    "%",
    "measured",
    RUNS,
    "18 38",
    "time-varying augmented",
)
FEWER_STATES = Printed(
    "Fig. 5.13",
    "0.261 kg at 0.55 m/s, less with q1 alone",
    "%",
    "measured",
    RUNS,
    "15 20",
    "time-invariant time-varying",
)

SAMPLING_LIMITS = Printed(
    "5.1",
    "sampling periods at which control is lost, eq. (5.6)",
    "s",
    "computed",
    EXACT,
    "0.02 0.007 0.0032",
    "1 2 3",
    "of the beam with the shaker of 3500 N/m",
)
SAMPLED_GAIN = Printed(
    "5.1",
    "gain of the sampled regulator, 5 ms, R = 9e-8",
    "",
    "computed",
    SAME_MODEL,
    "-356.7 -6250 2760.8 22.83 2.9 0.13 0.203",
    "q1 q2 q3 q1' q2' q3' z",
    "dlqr with Q and R as for continuous time, shaker of 3500 N/m",
)
FAST_GAIN = Printed(
    "5.1",
    "the same, 0.2 ms",
    "",
    "computed",
    SAME_MODEL,
    "3.09e12 2.181e12 3.45e11 -8.861e7 -4.01e7 9.54e11 16.46",
    "q1 q2 q3 q1' q2' q3' z",
)
MOVED_GAIN = Printed(
    "5.1",
    "the same, 10 ms, shaker at 0.25 m, two modes",
    "",
    "computed",
    SAME_MODEL,
    "215.07 -1665.74 -0.53 0.93 0.015",
    "q1 q2 q1' q2' z",
)
UNSTABLE = Printed(
    "Figs 5.17, 5.18",
    "frozen poles of the time-varying loop to the right: 1, or none: 0",
    "1",
    "computed",
    Tolerance("yes or no", absolute=0.5),
    "0 1 0",
    "few-states,0.55m/s few-states,5.6m/s all-states,5.6m/s",
    "0.509 kg",
)
UNSTABLE_BEYOND = Printed(
    "5.2",
    "few states, frozen poles to the right from",
    "m/s, kg",
    "computed",
    CURVE,
    "5.6 6.5",
    "speed,0.509kg mass,0.55m/s",
    "the speed that is shown is taken for the limit",
)

# Chapter 7: model predictive control, 0.509 kg at 1 m/s.
PREDICTIVE_ONE = Printed(
    "Fig. 7.1, Table 8.1", "one span, less by predictive control", "%", "computed", POINTS, "22"
)
SATURATED_ONE = Printed(
    "Figs 7.1, 7.2",
    "one span, first at 7.5 V",
    "s",
    "computed",
    SAMPLE,
    "0.04 0.32",
    "r_w=1e-11 r_w=1e-6",
)
PREDICTIVE_TWO = Printed(
    "Fig. 7.5, Table 8.1",
    "two spans, less by predictive control",
    "%",
    "computed",
    POINTS,
    "29 46 19",
    "s1,1st-half s2,1st-half s2,2nd-half",
    "r_w as for one span",
)
PREDICTIVE_FAR = Printed(
    "Figs 7.5, 7.7",
    "two spans, s1, less in the second half",
    "%",
    "computed",
    POINTS,
    "64 54",
    "Np=4,Nc=3 Np=6,Nc=4",
)
SATURATED_TWO = Printed(
    "Fig. 7.6",
    "two spans, first at a limit",
    "s",
    "computed",
    SAMPLE,
    "0.08 0.09",
    "u1,7.5V u2,-2.5V",
)
