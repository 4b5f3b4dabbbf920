"""Chapter 5: optimal control of one span with a shaker."""

from experiments.thesis.verdicts import SAME_CURVE, YES_OR_NO, PublishedNumbers, measured_shares

# Optimal control of one span with a shaker, peaks at 0.25 m in percent of no control.
RIG_A = "rig A, chapter 5"
# Static peaks without control at 0.25 m, the shaker passive (mm), by which tolerances are points.
PEAKS = 0.562, 0.799, 1.096
MASS_LABELS = "0.261kg 0.371kg 0.509kg"
INVARIANT_SLOW = measured_shares(
    "Table 5.1", "time-invariant, 0.3 m/s", "96.9 97.7 96.6", PEAKS, MASS_LABELS, rig=RIG_A
)
VARYING_SLOW = measured_shares(
    "Tables 5.1, 5.3", "time-varying, 0.3 m/s", "88 85.7 83.2", PEAKS, MASS_LABELS, rig=RIG_A
)
INVARIANT_FAST = measured_shares(
    "Table 5.2", "time-invariant, 0.55 m/s", "99.2 97.1 92", PEAKS, MASS_LABELS, rig=RIG_A
)
VARYING_FAST = measured_shares(
    "Tables 5.2, 5.4", "time-varying, 0.55 m/s", "87.2 83 82.1", PEAKS, MASS_LABELS, rig=RIG_A
)
AUGMENTED_SLOW = measured_shares(
    "Table 5.3", "augmented, 0.3 m/s", "67.12 67.85 66.29", PEAKS, MASS_LABELS, rig=RIG_A
)
AUGMENTED_FAST = measured_shares(
    "Table 5.4", "augmented, 0.55 m/s", "62.83 61.82 62.43", PEAKS, MASS_LABELS, rig=RIG_A
)
SUMMARY_OPTIMAL = measured_shares(
    "Table 8.1",
    "one span, 0.509 kg, reduction by optimal control",
    "18 38",
    (PEAKS[-1],),
    "time-varying augmented",
    repeats="Tables 5.2 and 5.4 for 0.509 kg",
    rig=RIG_A,
)
PARTIAL_FEEDBACK = measured_shares(
    "Fig. 5.13",
    "0.261 kg at 0.55 m/s, reduction with few states",
    "15 20 15",
    (PEAKS[0],),
    "time-invariant,q1 time-varying,q1 time-varying,q1,q2,q1'",
    runs=3,
    repeats="the case of Table 5.2, measured in another series",
    repeated_labels="time-varying,q1,q2,q1'",
    rig=RIG_A,
)
GAIN_SCHEDULING = measured_shares(
    "Fig. 5.24",
    "0.509 kg, gain designed for it instead of for 0.261 kg, further reduction",
    "10",
    (PEAKS[-1],),
    interpretation="points of the peak without control, at 0.3 m/s",
    rig=RIG_A,
)
DEEPEST_POSITION = PublishedNumbers(
    "Fig. 5.10", "0.5 kg at 0.3 m/s, where the beam is deepest under it", "m", "0.24", rig=RIG_A
)
MODE_TRUNCATION = PublishedNumbers(
    "Fig. 5.11",
    "bare beam, 0.261 kg at 0.55 m/s, deflection under the load, shortfall with two modes",
    "%",
    "1.14",
    interpretation="against three modes; the thesis does not state against how many",
    rig=RIG_A,
)
OBSERVED_REGULATOR = PublishedNumbers(
    "Fig. 5.5",
    "sampled regulator with an observer, reduction at 0.25 m",
    "%",
    "27",
    interpretation="0.2 ms, R = 9e-8, 0.501 kg at 0.5 m/s, shaker of 3500 N/m",
    rig=RIG_A,
)

SAMPLING_LIMITS = PublishedNumbers(
    "5.1",
    "sampling periods at which control is lost, eq. (5.6)",
    "s",
    "0.02 0.007 0.0032",
    "1 2 3",
    interpretation="of the beam with the shaker of 3500 N/m",
    repeats="the frequencies 24, 72 and 159 Hz, by eq. (5.6)",
    rig=RIG_A,
)
SAMPLED_GAIN = PublishedNumbers(
    "5.1",
    "gain of the sampled regulator, 5 ms, R = 9e-8",
    "",
    "-356.7 -6250 2760.8 22.83 2.9 0.13 0.203",
    "q1 q2 q3 q1' q2' q3' z",
    interpretation="dlqr with Q and R as for continuous time, shaker of 3500 N/m",
    rig=RIG_A,
)
FAST_GAIN = PublishedNumbers(
    "5.1",
    "the same, 0.2 ms",
    "",
    "3.09e12 2.181e12 3.45e11 -8.861e7 -4.01e7 9.54e11 16.46",
    "q1 q2 q3 q1' q2' q3' z",
    rig=RIG_A,
)
MOVED_SHAKER_GAIN = PublishedNumbers(
    "5.1",
    "the same, 10 ms, shaker at 0.25 m, two modes",
    "",
    "215.07 -1665.74 -0.53 0.93 0.015",
    "q1 q2 q1' q2' z",
    rig=RIG_A,
)
UNSTABLE_FROZEN_POLES = PublishedNumbers(
    "Figs 5.17, 5.18",
    "time-varying loop, frozen poles in the right half-plane: yes 1, no 0",
    "1",
    "0 1 0",
    "few-states,0.55m/s few-states,5.6m/s all-states,5.6m/s",
    tolerance=YES_OR_NO,
    interpretation="0.509 kg",
    rig=RIG_A,
)
FROZEN_POLE_LIMITS = PublishedNumbers(
    "5.2",
    "few states, speed and mass from which frozen poles are unstable",
    "m/s, kg",
    "5.6 6.5",
    "speed,0.509kg mass,0.55m/s",
    interpretation="the speed shown is taken as the limit",
    rig=RIG_A,
)
FED_BACK_STATES = PublishedNumbers(
    "Figs 5.14, 5.15",
    "0.261 kg at 0.55 m/s, statements on the states fed back: holds 1, does not 0",
    "1",
    "1 1 1",
    "varying:q1+q2+q1'<q1 varying:q1+q2<q1 constant:all>uncontrolled",
    tolerance=YES_OR_NO,
    rig=RIG_A,
)
IDENTICAL_GAINS = PublishedNumbers(
    "3.2",
    "largest difference of step-by-step from finite-time gains, of the largest of each state",
    "%",
    "0",
    tolerance=SAME_CURVE,
    interpretation="the gains are called identical",
    rig=RIG_A,
)
