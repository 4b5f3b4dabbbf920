"""Profiles in cases and their files: round trips, addresses, files of points, wrong input."""

import re

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.case import replace, unit_at, value_at
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_to_dict, profile_from_file, with_settings

BEAM = jb.Beam(length=25.0, flexural_rigidity=1e10, mass_per_length=1e4)
LOADS = [jb.MovingMass(1000.0, speed=20.0)]
CASE_TEXT = """
[beam]
length = 25.0
flexural_rigidity = 1e10
mass_per_length = 1e4
[[loads]]
kind = "mass"
mass = 1000.0
speed = 20.0
[profile]
"""


def read(tmp_path, table):
    """Case of a file with a profile."""
    path = tmp_path / "case.toml"
    path.write_text(CASE_TEXT + table)
    return jb.load_case(path)


def test_words_of_case_files(tmp_path):
    """`class` and `heights` there are `road_class` and `point_heights` in Python."""
    road = read(tmp_path, 'kind = "iso8608"\nclass = "B"\nseed = 3\n')
    assert road.profile.road_class == "B"
    assert with_settings(road, {"profile.class": "D"}).profile.road_class == "D"
    assert with_settings(road, {"profile.seed": 5}).profile.seed == 5
    table = read(tmp_path, 'kind = "table"\npositions = [0, 10, 25]\nheights = [0, 1e-3, 0]\n')
    assert value_at(table, "profile.heights.1") == 1e-3
    assert unit_at(table, "profile.heights") == "m"
    changed = replace(table, {"profile.heights.1": 2e-3})
    assert_allclose(changed.profile.heights(10.0)[0], 2e-3)
    both = 'kind = "iso8608"\nclass = "B"\nroad_class = "A"\n'
    with pytest.raises(ValueError, match="class is called road_class in Python; leave one"):
        read(tmp_path, both)


def test_addresses_are_differentiated():
    case = jb.Case(BEAM, profile=jb.profiles.RampProfile(5.0, 7.0, 0.01))

    def height(value):
        return replace(case, {"profile.height": value}).profile.heights(6.0)[0]

    assert_allclose(jax.grad(height)(0.01), 0.5)


def test_a_case_has_no_profile_without_one():
    assert jb.Case(BEAM).profile is None
    assert "profile" not in case_to_dict(jb.Case(BEAM))


@pytest.mark.parametrize(
    "text",
    [
        "0,0\n10,0.003\n25,0.001\n",
        "# measured in May\nposition (m), height (m), lane\n\n0, 0, 1\n10, 3e-3, 1\n25, 1e-3, 1\n",
        "x;r\n0;0\n10;0.003\n25;0.001\n",
        "0 0\n10\t0.003\n 25   0.001",
    ],
)
def test_a_measured_profile_from_a_file(text, tmp_path):
    """Relative to the folder of the case file; saved cases have the points themselves."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "profile.csv").write_text(text)
    case = read(tmp_path, 'kind = "table"\nfile = "data/profile.csv"\ncontact_length = 0.2\n')
    assert_array_equal(case.profile.positions, [0.0, 10.0, 25.0])
    assert_array_equal(case.profile.point_heights, [0.0, 3e-3, 1e-3])
    assert case.profile.contact_length == 0.2
    jb.save_case(case, tmp_path / "saved.toml")
    again = jb.load_case(tmp_path / "saved.toml").profile
    assert_array_equal(again.point_heights, case.profile.point_heights)
    profile = profile_from_file(tmp_path / "data" / "profile.csv")
    assert_array_equal(profile.positions, case.profile.positions)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0\n10,three\n", "line 2: a line of a profile is a position and a height in m"),
        ("0,0\n10\n", "line 2: a line of a profile"),
        ("x,r\nm,m\n0,0\n", "line 2: a line of a profile"),
        ("x,r\n0,0\n", "at least two points; it has 1"),
        ("", "at least two points; it has 0"),
    ],
)
def test_wrong_files_of_points(text, message, tmp_path):
    (tmp_path / "profile.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        profile_from_file(tmp_path / "profile.csv")
    assert "profile.csv" in str(raised.value)


def test_missing_file_and_points_given_twice(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cannot read the profile .*none.csv"):
        read(tmp_path, 'kind = "table"\nfile = "none.csv"\n')
    (tmp_path / "profile.csv").write_text("0,0\n25,0\n")
    with pytest.raises(ValueError, match="both a file and positions; leave one out"):
        read(tmp_path, 'kind = "table"\nfile = "profile.csv"\npositions = [0, 1]\n')
    with pytest.raises(ValueError, match="profile.file must be the name of a file"):
        read(tmp_path, 'kind = "table"\nfile = 3\n')
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="text in UTF-8"):
        read(tmp_path, 'kind = "table"\nfile = "binary.csv"\n')


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('kind = "wavy"', "profile.kind cannot be 'wavy'; it may be bump, iso8608"),
        ('kind = "sine"\namplitude = 1.0', "profile.wavelength is missing; give the distance"),
        ('kind = "sine"\namplitude = 1\nwavelength = 0', "wavelength must be positive; it is 0 m"),
        ('kind = "ramp"\nstart = 3\nend = 2\nheight = 1', "profile.end must lie to the right of"),
        ('kind = "step"\nstart = 3\nend = 3\nheight = 1', "3 m is not beyond 3 m"),
        (
            'kind = "bump"\nstart = 1\nend = 3\nheight = 1\ncontact_length = -1',
            "profile.contact_length must be positive; it is -1 m",
        ),
        (
            'kind = "table"\npositions = [0, 9]\nheights = [0, 0, 0]',
            "has 2 positions and 3 heights; a table needs one height for each",
        ),
        ('kind = "table"\npositions = [0]\nheights = [0]', "needs at least two points; it has 1"),
        (
            'kind = "table"\npositions = [0, 9, 9]\nheights = [0, 0, 0]',
            "profile.positions.2 must be above the entry before it; 9 m follows 9 m",
        ),
        (
            'kind = "table"\npositions = [0, 9]\nheights = [0, 0.01]',
            "ends at 9 m with a height of 0.01 m, but loads travel from 0 to 25 m: extend the",
        ),
        (
            'kind = "table"\npositions = [1, 30]\nheights = [0.1, 0.01]',
            "begins at 1 m with a height of 0.1 m, but loads travel from 0 to 25 m",
        ),
        (
            'kind = "spectrum"\nwavenumbers = [0.1, 0.2]\namplitudes = [1]\nphases = [0, 0]',
            "has 2 wavenumbers and 1 amplitudes; a spectrum needs one of each",
        ),
        (
            'kind = "spectrum"\nwavenumbers = []\namplitudes = []\nphases = []',
            "profile.wavenumbers needs at least one entry",
        ),
        (
            'kind = "spectrum"\nwavenumbers = [0.0]\namplitudes = [1]\nphases = [0]',
            "profile.wavenumbers.0 must be positive; it is 0 1/m",
        ),
        (
            'kind = "spectrum"\nwavenumbers=[1]\namplitudes=[1]\nphases=[0]\nswitch_on = [2, 2]',
            "profile.switch_on needs two different positions",
        ),
        ('kind = "iso8608"', "profile.road_class is missing; give the roughness class"),
        ('kind = "iso8608"\nclass = "J"', "class cannot be 'J'; it may be A, B, C, D, E, F, G, H"),
        ('kind = "iso8608"\nclass = "A"\nseed = -1', "seed must be a whole number, 0 or more"),
        (
            'kind = "iso8608"\nclass = "A"\nlowest_wavenumber = 5',
            "profile.lowest_wavenumber must be below profile.highest_wavenumber; 5 1/m is not",
        ),
        ('kind = "rail"\nspectrum = "fra-7"', "spectrum cannot be 'fra-7'; did you mean 'fra-"),
        (
            'kind = "rail"\nspectrum = "sncf"\nshortest_wavelength = 50',
            "profile.shortest_wavelength must be below profile.longest_wavelength; 50 m is not",
        ),
        ('kind = "table"\npoints = [0, 1]', "profile has no key 'points'"),
    ],
)
def test_wrong_input_is_one_sentence(table, message, tmp_path):
    with pytest.raises(ValueError, match=re.escape(message)) as raised:
        read(tmp_path, table)
    assert "\n" not in str(raised.value)


def test_a_table_may_be_local_where_it_ends_at_height_zero():
    profile = jb.profiles.TableProfile(np.linspace(5.0, 8.0, 7), [0, 0, 1e-3, 2e-3, 1e-3, 0, 0])
    check_case(jb.Case(BEAM, loads=LOADS, profile=profile))


def test_wrong_part_in_python():
    with pytest.raises(ValueError, match="profile holds a Beam; it takes objects of type"):
        check_case(jb.Case(BEAM, profile=BEAM))


def test_traced_numbers_are_not_validated():
    def valid(height):
        loads = [jb.MovingForce(force=1e4, speed=20.0)]
        case = jb.Case(BEAM, loads=loads, profile=jb.profiles.RampProfile(height, height, height))
        check_case(case)
        return case.profile.height

    assert jax.jit(valid)(0.5) == 0.5


CAR = {
    "body_mass": 14000.0,
    "axle_mass": 1100.0,
    "suspension_stiffness": 9e5,
    "suspension_damping": 3e4,
    "tyre_stiffness": 3e6,
}
RIGID = {
    "mass": jb.MovingMass(1000.0, speed=20.0),
    "wheel": jb.Oscillator(1e4, 1e6, wheel_mass=10.0, speed=20.0),
    "wagon": jb.vehicles.VehicleLoad(model="manchester-wagon", speed=20.0),
    "masses": jb.Axles(offsets=[0.0, 2.0], masses=1e3, speed=20.0),
}


@pytest.mark.parametrize("name", RIGID)
def test_masses_on_the_surface_may_pass_any_profile(name):
    """By an impulse at the ends of a ramp: see `tests/simulation/test_kinks.py`."""
    ramp = jb.profiles.RampProfile(5.0, 7.0, 0.01)
    for profile in (
        ramp,
        jb.profiles.RampProfile(5.0, 7.0, 0.01, 0.2),
        jb.profiles.StepProfile(5.0, 7.0, 0.01),
    ):
        check_case(jb.Case(BEAM, loads=[RIGID[name]], profile=profile))


@pytest.mark.parametrize(
    ("path", "travel"),
    [
        ({"speed": 20.0, "start_position": -12.0}, "from -12 to 25 m"),
        ({"speed": 20.0, "entry_time": 0.5}, "from -10 to 25 m"),
        ({"speed": -20.0, "start_position": 40.0}, "from 0 to 40 m"),
        ({"times": [0.0, 1.0, 2.0], "positions": [-3.0, 4.0, 30.0]}, "from -3 to 25 m"),
    ],
)
def test_tables_are_known_where_vehicles_come_from(path, travel):
    load = jb.QuarterCar(**CAR, **path)
    short = jb.profiles.TableProfile([-1.0, 10.0, 26.0], [0.01, 0.0, 0.01])
    run = jb.Run(2.0)
    with pytest.raises(ValueError, match=f"loads travel {travel}"):
        check_case(jb.Case(BEAM, loads=[load], profile=short, run=run))
    long = jb.profiles.TableProfile([-20.0, 10.0, 50.0], [0.01, 0.0, 0.01])
    check_case(jb.Case(BEAM, loads=[load], profile=long, run=run))


def test_all_wheels_travel():
    load = jb.vehicles.VehicleLoad(model="truck-5-axle", speed=20.0)
    profile = jb.profiles.TableProfile([-5.0, 10.0, 50.0], [0.01, 0.0, 0.01])
    with pytest.raises(ValueError, match=r"loads travel from -12\.8 to 37\.8 m"):
        check_case(jb.Case(BEAM, loads=[load], profile=profile, run=jb.Run(3.0)))
