"""Keys of `--json`, which programs of users read: fields may be renamed, these may not."""

import pytest

MARGIN = {"verdict": None, "gain": None, "delay": None, "obstacle": None, "unstable": None}
MARGINS = [{"gain": None, "gain_down": None, "phase": None, "delay": None, "distance": None}]
LIMIT_CYCLES = [{"extra": None, "frequency": None, "at_limits": None}]
COMPARISON = {
    "uncontrolled_peak": None,
    "least_peak": None,
    "held_for": None,
    "controllers": {
        "controlled": {
            "peak": None,
            "rms": None,
            "after_exit": None,
            "effort": None,
            "saturated": None,
            "share": None,
            "stability_margin": MARGIN,
            "reserve": MARGIN,
            "limit_cycles": LIMIT_CYCLES,
            "swings": LIMIT_CYCLES,
            "loop": None,
            "verdict": None,
        }
    },
}
METRICS = {"peak", "worst_share", "mean_share", "after_exit", "saturated"}

PLAUSIBILITY = dict.fromkeys(
    (
        "first_frequency",
        "span",
        "deflection",
        "own_deflection",
        "mass_ratio",
        "crossing_time",
        "speed",
        "critical_speed",
        "warnings",
        "span_over_deflection",
        "speed_ratio",
    )
)

KEYS = {
    "check case.toml": PLAUSIBILITY,
    "modes case.toml": {"frequencies_hz": None, "damping_ratios": None},
    "frf case.toml --pair force@0.3:deflection@0.3 --points 3": {
        "frequencies_hz": None,
        "responses": [
            {"input": None, "output": None, "unit": None, "magnitude": None, "phase_deg": None}
        ],
    },
    "simulate controlled.toml": {
        "sensors": [
            {
                "name": None,
                "quantity": None,
                "unit": None,
                "position": None,
                "smallest": None,
                "smallest_time": None,
                "largest": None,
                "largest_time": None,
                "dynamic_amplification": None,
                "step_error": None,
                "truncation_error": None,
            }
        ],
        "peak_deflection": None,
        "lowest_contact_force": None,
        "largest_contact_force": None,
        "wheel_unloading": None,
        "contact_lost_time": None,
        "error_estimate": None,
        "steps": None,
        "peak_command": None,
        "effort": None,
        "saturated": None,
        "verdict": None,
        "stability": None,
        "plausibility": PLAUSIBILITY,
    },
    "describe case.toml": {
        "case": PLAUSIBILITY | {"frequencies_hz": None},
        "vehicles": [
            {
                "title": None,
                "source": None,
                "wheelbase": None,
                "weight": None,
                "mass": None,
                "offsets": None,
                "static_loads": None,
                "unsprung_masses": None,
                "degrees_of_freedom": None,
                "frequencies_hz": None,
            }
        ],
    },
    "sweep case.toml --over loads.0.mass=0.3,0.5": {
        "values": {"loads.0.mass": None},
        "dimensions": None,
        "failed_runs": None,
        "error_estimate": None,
        "peak_deflection": None,
        "plausibility": PLAUSIBILITY,
    },
    "stability controlled.toml --limits --headway 0.5 --mass-at 0.2=0.3": {
        "verdict": None,
        "along_crossing": {"gain": None, "delay": None, "obstacle": None},
        "stable_without_loads": None,
        "margins": MARGINS,
        "mass_at": [{"position": None, "mass": None, "verdict": None, "margins": MARGINS}],
        "largest_real_part": None,
        "at_time": None,
        "largest_growth": None,
        "largest_multiplier": None,
        "unstable_from": {
            "loads frozen": {"mass": None, "speed": None},
            "a stream": {"mass": None, "speed": None},
        },
    },
    "compare controlled.toml --period 0.05": COMPARISON,
    "compare controlled.toml --period 0.05 --over loads.0.mass=0.5": {
        "cases": [{"values": {"loads.0.mass": None}} | COMPARISON],
        "over_all": {"controlled": dict.fromkeys(METRICS)},
    },
}


def keys(content):
    """Keys of decoded JSON, at every level; those of a list are the keys of its first entry."""
    if isinstance(content, dict):
        return {key: keys(value) for key, value in content.items()}
    if isinstance(content, list) and content and isinstance(content[0], dict):
        return [keys(content[0])]
    return None


@pytest.mark.parametrize("line", KEYS)
def test_keys(run, line):
    assert keys(run(f"{line} --json")) == KEYS[line]
