"""`jaxbeam describe`: vehicles of files, of cases, of the library."""

import inspect
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.benchmark.problem import TEST_SEEDS
from jaxbeam.cli import main
from jaxbeam.cli.app import RENAMED_COMMANDS, RENAMED_OPTIONS, app, refuse_former_words
from jaxbeam.cli.arguments import bounds_in_si, pair_in_si, parse_bounds, parse_prior
from jaxbeam.cli.commands.start import KINDS

CART = """
[[bodies]]
name = "cart"
mass = 800.0
inertia = 500.0
[[axles]]
body = "cart"
position = 1.5
tyre_stiffness = 2.0e5
[[axles]]
body = "cart"
position = -1.5
tyre_stiffness = 2.0e5
"""


def test_vehicle_file(folder, run):
    (folder / "cart.toml").write_text(CART)
    printed = run("describe cart.toml")
    assert "weight 7.848 kN, mass 800 kg, wheelbase 3 m" in printed
    assert "degrees of freedom: cart, cart pitch" in printed
    (vehicle,) = run("describe cart.toml --json")["vehicles"]
    assert vehicle["static_loads"] == pytest.approx([3924.0, 3924.0])
    expected = np.sqrt([4e5 / 800, 4e5 * 1.5**2 / 500]) / (2 * np.pi)
    assert vehicle["frequencies_hz"] == pytest.approx(expected)


def test_case_file(run):
    printed = run("describe case.toml")
    assert "loads.0: mass" in printed and "weight 4.905 N, mass 0.5 kg" in printed


def test_settled_supports(folder, run):
    """3 E I s / l^2 over the middle support."""
    text = (folder / "case.toml").read_text()
    (folder / "case.toml").write_text(text + '[[supports]]\nposition = 0.3\nsettlement = "1 mm"\n')
    moment = 3 * 11.68 * 1e-3 / 0.3**2
    expected = f"settled: supports.0 by 1 mm; moments locked in from 0 N m to {moment:.4g} N m"
    assert expected in run("describe case.toml")
    assert f"{expected}; sensors read changes from there" in run("simulate case.toml")


CAR_AND_ABSORBER = """
[beam]
length = 20.0
flexural_rigidity = 2e10
mass_per_length = 12e3
[[absorbers]]
position = 10.0
mass = 2000.0
frequency = 4.0
damping_ratio = 0.1
[[loads]]
kind = "oscillator"
mass = 15e3
stiffness = 1e6
speed = 22.0
[run]
duration = 1.0
sample_rate = 200.0
"""


def test_absorbers_beside_vehicles_have_no_measures_of_ride(folder, run):
    """The command ended in an error of zip()."""
    (folder / "both.toml").write_text(CAR_AND_ABSORBER)
    rows = [line.split() for line in run("simulate both.toml").splitlines()]
    (absorber,) = [row for row in rows if row[:2] == ["absorbers.0", "body"]]
    (vehicle,) = [row for row in rows if row[:1] == ["loads.0"]]
    assert absorber[-3:] == ["-"] * 3 and len(vehicle) == len(absorber)


def test_case_of_a_train_in_words(run, folder):
    """Units with prefixes, when the loads are on the beam, the first and the last of 50 axles."""
    run("new railway-bridge")
    printed = run("describe railway-bridge.toml")
    for text in (
        "beam of 25 m, pinned-pinned: E I = 30 GN m², 15000 kg/m",
        "1/3732 of the span of 25 m",
        "critical speed: 177.7 m/s (639.8 km/h)",
        "loads.0: HSLM-A1 at 60 m/s (216 km/h), on the beam from 0 s to 7.042 s",
        "the run ends at 18 s",
        "sensors: midspan (deflection at 12.5 m), deck (acceleration at 12.5 m)",
        "50 wheels, of which",
        "397.525",
    ):
        assert text in printed
    assert len(printed.splitlines()) < 35


def test_library(run):
    assert "truck-5-axle" in run("describe") and "HSLM-A10" in run("describe")
    assert "55.1622" in run("describe truck-5-axle")
    assert "weight 8500 kN" in run("describe HSLM-A1")


def test_unknown_names_are_refused(refused):
    assert "did you mean 'truck-5-axle'?" in refused("describe truck-5-axel")
    assert "cannot read the file none.toml" in refused("describe none.toml")


def test_picture(folder, run):
    (folder / "cart.toml").write_text(CART)
    for source, picture in (("cart.toml", "cart.png"), ("case.toml", "case.png")):
        assert f"written: {picture}" in run(f"describe {source} --plot {picture}")
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")


# Command `compare` over random runs.

CASE = """
[beam]
length = 0.6
flexural_rigidity = 12.0
mass_per_length = 0.5
damping_ratio = 0.03
modes = 1
[[sensors]]
position = 0.3
[[actuators]]
kind = "point"
position = 0.3
limits = [-2.0, 5.0]
[[loads]]
kind = "mass"
mass = 0.4
speed = 2.0
entry_time = 0.1
[controller]
kind = "feedback"
gains = [500.0]
period = 0.02
[run]
duration = 0.5
sample_rate = 100.0
"""
RUNS = """
[training]
draws = 2
"loads.0.mass" = [0.3, 0.4]
"beam.flexural_rigidity" = [11.0, 13.0]
"""


def test_compare_over_the_runs_of_a_file(tmp_path, capsys):
    case, runs = tmp_path / "weak.toml", tmp_path / "runs.toml"
    case.write_text(CASE)
    runs.write_text(RUNS)
    with pytest.raises(SystemExit, match="0"):
        main(["compare", str(case), "--cases", str(runs), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert list(found["over_all"]) == ["weak", "drawn by hand"]
    assert len(found["cases"]) == 2
    assert all(11 < one["values"]["beam.flexural_rigidity"] < 13 for one in found["cases"])
    shares = [one["controllers"]["weak"]["share"] for one in found["cases"]]
    assert found["over_all"]["weak"]["worst_share"] == min(shares)
    with pytest.raises(SystemExit, match="2"):
        main(["compare", str(case), "--cases", str(runs), "--over", "loads.0.mass=1,2"])
    assert "--cases has runs of its own" in capsys.readouterr().err


# Bounds of free parameters, with and without units.

FORCE_CASE = jb.Case(jb.Beam(25.0, 3e10, 1.5e4), loads=[jb.MovingForce(force=1e5, speed=20.0)])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("beam.flexural_rigidity=8 GN m^2:12 GN m^2", (8e9, 12e9)),
        ("beam.flexural_rigidity=8000 MN m^2 : 1.2e10 N m^2", (8e9, 12e9)),
        ("loads.*.speed=36 km/h:20 m/s", (10.0, 20.0)),
        ("beam.length=20:30", (20.0, 30.0)),
        ("beam.length", None),
    ],
)
def test_bounds_in_si_units(text, expected):
    address, pair = parse_bounds(text)
    found = bounds_in_si(FORCE_CASE, {address: pair})[address]
    assert found == (expected and pytest.approx(expected))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("beam.length=25 m:20 m", "--free beam.length: bounds are LOW:HIGH"),
        ("beam.length=25 m:30 kg", "must be in m, or a unit of the same kind, not '30 kg'"),
        ("beam.lenght=25 m:30 m", "did you mean .beam.length"),
    ],
)
def test_bounds_that_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        bounds_in_si(FORCE_CASE, dict([parse_bounds(text)]))


def test_priors_in_si_units():
    address, pair = parse_prior("beam.flexural_rigidity=30 GN m^2:500 MN m^2")
    assert pair_in_si(FORCE_CASE, address, pair, "--prior") == pytest.approx((3e10, 5e8))
    assert parse_prior("beam.length=25:0.1") == ("beam.length", (25.0, 0.1))
    with pytest.raises(ValueError, match="give both numbers a unit, as in"):
        parse_prior("beam.length=25 m:0.1")
    with pytest.raises(ValueError, match="--prior beam.length.1 must be in m"):
        pair_in_si(FORCE_CASE, "beam.length", ("25 m", "1 kg"), "--prior")


# Former words of commands and options are refused by a sentence that names the present ones.

OPTIONS = [
    (command, old, new) for command, names in RENAMED_OPTIONS.items() for old, new in names.items()
]


def parameters(command: str) -> set[str]:
    """Options of a command."""
    return {
        name for argument in app[command].assemble_argument_collection() for name in argument.names
    }


@pytest.mark.parametrize(("old", "new"), RENAMED_COMMANDS.items())
def test_former_commands(old, new):
    with pytest.raises(ValueError, match=f"^{old} is called {new} now$"):
        refuse_former_words([old, "case.toml"])
    assert inspect.isfunction(app[new].default_command)


@pytest.mark.parametrize(("command", "old", "new"), OPTIONS)
def test_former_options(command, old, new):
    for given in ([old, "1"], [f"{old}=1=2"]):
        with pytest.raises(ValueError, match=f"^{old} is called {new} now$"):
            refuse_former_words([command, "a.toml", *given])
    assert new in parameters(command)
    assert old not in parameters(command)


def test_present_words_and_those_of_other_commands_pass():
    refuse_former_words(["sweep", "case.toml", "--over", "loads.0.mass=1,2"])
    refuse_former_words([])


def test_a_former_option_ends_the_command(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["design-experiment", "case.toml", "--over", "loads.0.speed=1:2"])
    assert ended.value.code != 0
    assert capsys.readouterr().err == "jaxbeam: --over is called --vary now\n"


# Cases to start from: they are plausible, and run as they are.


@pytest.mark.parametrize("kind", KINDS)
def test_a_starter_case_runs_as_it_is(run, folder, kind):
    assert f"written: {kind}.toml" in run(f"new {kind}")
    assert run(f"check {kind}.toml --json")["warnings"] == []
    found = run(f"simulate {kind}.toml --json")
    assert found["error_estimate"] < 1e-3
    assert all(sensor["smallest"] < sensor["largest"] for sensor in found["sensors"])


def test_a_file_is_not_overwritten(refused, run, folder):
    (folder / "mine.toml").write_text("precious")
    assert "mine.toml exists" in refused("new footbridge -o mine.toml")
    assert (folder / "mine.toml").read_text() == "precious"
    run("new footbridge -o mine.toml --overwrite")
    assert "Footbridge" in (folder / "mine.toml").read_text()
    assert "no case of kind 'bridge'" in refused("new bridge")


# Keys of `--json`, which programs of users read: fields may be renamed, these may not.

MARGIN = {"verdict": None, "gain": None, "delay": None, "obstacle": None, "unstable": None}
MARGINS = [{"gain": None, "gain_down": None, "phase": None, "delay": None, "distance": None}]
LIMIT_CYCLES = [{"extra": None, "frequency": None, "at_limits": None}]
COMPARISON = {
    "headline": None,
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
            "damper_peak": None,
            "dampers": None,
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


# Command `benchmark`: the stored tables, and scores of a controller.


def test_the_command_prints_the_tables(run, refused):
    printed = run("benchmark")
    assert all(name in printed for name in jb.benchmark.names())
    found = run("benchmark patch --json")
    assert_allclose(found["score"], jb.benchmark.baselines()["patch"].mean)
    assert [row["seed"] for row in found["runs"]] == list(TEST_SEEDS)
    assert "has footbridge" in refused("benchmark rope")
    assert "name it" in refused("benchmark --seed 3")


def test_the_command_scores_a_controller(run, folder):
    (folder / "law.toml").write_text(
        '[controller]\nkind = "feedback"\ngains = [4000.0]\nperiod = 0.01\nresolution = 0.01\n'
    )
    found = run("benchmark unknown_mass --controller law.toml --seed 1 --json")
    law = jb.Feedback(gains=[4000.0], period=0.01, resolution=0.01)
    expected = jb.benchmark.score("unknown_mass", law, seed=1)
    assert_allclose(found["score"], expected.mean, rtol=1e-9)
    assert found["runs"][0]["seed"] == 1


HELP = {
    "monitor": "temperatures and other conditions, and a control chart of the residuals",
    "benchmark": "0 % without control; no controller exceeds 100 %.\n",
    "sweep": "at the fastest of the speeds, 1 % of it is left at the bridge.",
}


@pytest.mark.parametrize("command", HELP)
def test_terminals_wrap_the_help(command, capsys, monkeypatch):
    """Not the source does; which errors Python raises is no matter of a command line."""
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    printed = capsys.readouterr().out
    assert HELP[command] in printed
    assert "Raises" not in printed
