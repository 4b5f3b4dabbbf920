"""Commands: results printed and files written; one sentence for a command line that is wrong."""

import functools
import itertools
import json
import math
import sys

import numpy as np
import pytest
import xarray
from PIL import Image

from jaxbeam.cli import main
from jaxbeam.files.case_file import load_case
from jaxbeam.model.load_set import load_set
from tests.cli.example import CASE

TRUCKS = """
[beam]
length = 20.0
flexural_rigidity = 1e10
mass_per_length = 12e3
damping_ratio = 0.02
modes = 3
[profile]
kind = "sine"
amplitude = "3 mm"
wavelength = 4.0
[[sensors]]
position = 10.0
[[loads]]
kind = "train"
speed = 20.0
coaches = [{ model = "truck-5-axle", count = 2, length = 20.0 }]
[run]
duration = 3.0
sample_rate = 200.0
"""


def frequency(n: int, rigidity: float = 11.68) -> float:
    """Natural frequency n (Hz) of the pinned beam, (n pi / L)^2 sqrt(E I / m) / 2 pi."""
    return (n * math.pi / 0.6) ** 2 * math.sqrt(rigidity / 0.535) / (2 * math.pi)


# Command lines refused before any computation

REFUSED = [
    ("simulat case.toml", 'Unknown command "simulat". Did you mean "simulate"?'),
    ("simulate case.toml more", "simulate takes no further 'more'; see jaxbeam simulate --help"),
    ("simulate", "simulate needs CASE: Case file, TOML; see jaxbeam simulate --help"),
    ("simulate case.toml --plott", "--plott"),
    ("simulate none.toml", "cannot read the case file none.toml: no such file or directory"),
    ("simulate case.toml -o out.txt", "a record is written to a .nc file; call it out.nc"),
    ("simulate case.toml -o none/out.nc", "there is no folder none to write out.nc to"),
    ("simulate case.toml -o old.nc", "old.nc exists; choose another name or add --overwrite"),
    (
        "sweep case.toml --over loads.0.speed=1,2 -o old.zarr",
        "old.zarr exists; choose another name or add --resume or --overwrite",
    ),
    ("simulate case.toml --animate out.avi", "an animation is written to a file of .gif or .mp4"),
    (
        "simulate case.toml --picture out.jpg",
        "a picture is written to a .png file; call it out.png",
    ),
    ("simulate case.toml --plot --size 160x100", "--size takes WIDTHxHEIGHT in mm, cm or in, such"),
    ("modes case.toml --plot --size 1x100mm", "a side is 25 mm at least and 2540 mm at most"),
    ("frf case.toml --plot --dpi 1", "--dpi must be from 10 to 2400; it is 1"),
    ("identify one.csv two.csv --picture out.png", "--picture names one file, and each log has"),
    ("simulate case.toml --set loads.0.speed", "--set takes ADDRESS=VALUE, such as"),
    ("simulate case.toml --set loads.0.sped=1", "loads.0 has no key 'sped'; did you mean 'speed'?"),
    ("simulate case.toml --set loads.1.speed=1", "no number at address 'loads.1.speed'; did you"),
    ("simulate case.toml --set loads.0.speed=fast", "must be one number, not 'fast'"),
    ("simulate case.toml --set beam.length=-1", "beam.length must be positive; it is -1 m"),
    ("modes case.toml --set beam.ends=pinned-fre", "no end is called 'fre'; did you mean 'free'?"),
    ("sweep case.toml", "sweep needs --over: ADDRESS=START"),
    ("sweep case.toml --over loads.0.speed=1:2", "a range is START:STOP:COUNT, such as 0.3:10:64"),
    (
        "sweep case.toml --over loads.0.speed=40:5:90",  # as in MATLAB
        "not START:STEP:STOP: in steps of 5 write 40:90:11, and 90 values downwards as 5:40:90",
    ),
    ("sweep case.toml --over loads.0.speed=1:2:0.5", "a range is START:STOP:COUNT"),
    ("sweep case.toml --over loads.0.speed=1:2:1000000000", "a range may have 1e+07 values"),
    ("sweep case.toml --over loads.0.speed=1,x", "--over loads.0.speed=1,x: 'x' is not a number"),
    (
        "sweep case.toml --over loads.0.speed=1,2 --over loads.0.speed=1,2",
        "--over names loads.0.speed twice",
    ),
    ("sweep case.toml --over loads.0.train=HSLM-A1,2", "'HSLM-A1' is not a number"),
    ("sweep case.toml --over loads.0.speed=1,2 --resume", "--resume needs the store to continue"),
    (
        "sweep case.toml --over loads.0.speed=1,2 --resume -o out.csv",
        "--resume needs a store of blocks: -o OUT.zarr",
    ),
    (
        "sweep case.toml --over loads.0.speed=1,2 --fractile loads.0.mass=0.5",
        "loads.0.mass is not swept; it is taken over one of loads.0.speed",
    ),
    (
        "sweep case.toml --over loads.0.speed=1,2 --fractile loads.0.speed=95",
        "fractiles are numbers from 0 to 1, such as 0.95",
    ),
    (
        "sweep case.toml --over loads.0.speed=1,2 --limit strain=1",
        "--limit takes QUANTITY=VALUE of a quantity that a sensor reads",
    ),
    ("sweep case.toml --over loads.0.speed=1,2 -o out.txt", "a sweep is written to a .zarr file"),
    ("frf case.toml --from 0", "--from and --to must increase from above 0 Hz; they are 0, 1000"),
    ("frf case.toml --from 10 --to 1", "--from and --to must increase from above 0 Hz"),
    ("frf case.toml --points 1", "--points must be from 2 to 1e+06; it is 1"),
    ("export case.toml -o t.csv --points 1000000000", "--points must be from 2 to 1e+06"),
    ("frf case.toml --points 1000000000", "--points must be from 2 to 1e+06; it is 1000000000"),
    ("frf case.toml --pair force@0.3", "--pair takes INPUT:OUTPUT, such as actuators.0:sensors.0"),
    ("frf case.toml --pair force@0.3:sensors.2", "'sensors.2' does not exist; the case has 2"),
    ("frf case.toml --mass-at 0.3", "--mass-at takes POSITION=MASS in m and kg, such as 0.3=0.5"),
    ("frf case.toml --mass-at 0.3=a", "--mass-at 0.3=a: 'a' is not a number"),
    ("frf case.toml --mass-at 0.7=0.5", "the position of a stationary mass must lie on the beam"),
    ("frf case.toml -o out.png", "a frequency response is written to a .nc file; call it out.nc"),
    ("identify", "identify needs at least one log: jaxbeam identify [CASE.toml] LOG..."),
    ("identify case.toml", "identify needs at least one log"),
    ("identify case.toml case.toml log.csv", "identify fits one case, not 2: case.toml, case.toml"),
    ("identify log.csv --free beam.length", "--free needs the case whose numbers it names"),
    ("identify log.csv -o fit.toml", "-o and --set are for fitting a case; name what is free"),
    ("identify case.toml log.csv --free beam.length=2:1", "bounds are LOW:HIGH, such as 5:20"),
    ("identify case.toml log.csv --free beam.length=0:b", "'b' is not a number"),
    ("identify case.toml log.csv --free beam.length=1:2m", "give both numbers a unit, as in 8 GN"),
    ("identify case.toml log.csv --free beam.length -o case.toml", "case.toml exists; choose"),
    (
        "weigh case.toml old.nc --speeds 5:20 --calibration old.nc",
        "--calibration is for axles: say how many --axles, or --axles auto",
    ),
    ("weigh calibrate case.toml", "weigh calibrate needs a log: jaxbeam weigh calibrate CASE"),
    (
        "weigh case.toml old.nc --speeds 5:20 --axles 2 --calibration a.json --calibration old.nc",
        "--calibration takes one file of lines",
    ),
    (
        "weigh case.toml old.nc --speeds 5:20 --axles many",
        "--axles takes a whole number, or auto, not 'many'",
    ),
]


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_wrong_command_lines_are_refused(folder, refused, line, message):
    for name in ("old.nc", "old.zarr"):
        (folder / name).touch()
    assert message in refused(line)


# Commands that compute


def test_modes(run, folder):
    found = run("modes case.toml --json --set beam.modes=4")
    expected = [frequency(n) for n in (1, 2, 3, 4)]
    np.testing.assert_allclose(found["frequencies_hz"], expected, rtol=1e-9)
    np.testing.assert_allclose(found["damping_ratios"], 0.03, rtol=1e-9)
    printed = run("modes case.toml --plot")
    assert f"{frequency(1):.6g}" in printed
    assert "written: case_modes.png" in printed
    assert (folder / "case_modes.png").read_bytes().startswith(b"\x89PNG")


def films_of(frames: int, monkeypatch) -> None:
    """Let commands write films of few frames."""
    from jaxbeam import plot

    monkeypatch.setattr(plot, "animate", functools.partial(plot.animate, frames=frames))


def test_simulate_prints_and_writes_the_same(run, folder, monkeypatch):
    import jaxbeam as jb

    films_of(3, monkeypatch)
    record = jb.simulate(load_case(folder / "case.toml"))
    found = run("simulate case.toml --json")
    np.testing.assert_array_equal(found["peak_deflection"], record.peak_deflection)
    factors = [sensor["dynamic_amplification"] for sensor in found["sensors"]]
    np.testing.assert_allclose(
        factors, jb.sections.amplification(record.case, [0.3, 0.15]), rtol=1e-6
    )
    assert found["largest_contact_force"] == [float(record.contact_force.max())]
    printed = run("simulate case.toml -o out.nc --plot --animate out.gif")
    assert f"{factors[0]:.4g}" in printed and f"{found['steps']} steps" not in printed
    assert f"{float(record.peak_deflection[0]):.6g}" in printed
    assert "written: out.nc" in printed
    assert (folder / "out.nc").stat().st_size > 0
    assert (folder / "out.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "out.gif").read_bytes().startswith(b"GIF89a")


def test_pictures_have_endings_sizes_and_titles(run, folder):
    """Width and height in millimetres, dots per inch and title of every command that draws."""
    lines = (
        "simulate case.toml",
        "sweep case.toml --over loads.0.speed=1,2",
        "modes case.toml",
        "frf case.toml --points 20",
    )
    for line in lines:
        run(f"{line} --picture out.png --size 127x76.2mm --dpi 100 --title Anew --overwrite")
        with Image.open(folder / "out.png") as picture:
            assert picture.size == (500, 300)
        run(f"{line} --picture out.svg --title Anew --overwrite")
        text = (folder / "out.svg").read_text()
        assert "<!-- Anew -->" in text and "one span, one ball" not in text
    run("simulate case.toml --picture out.svg --labels near,far --overwrite")
    assert "<!-- near" in (folder / "out.svg").read_text()
    run("modes case.toml --picture out.pdf")
    assert (folder / "out.pdf").read_bytes().startswith(b"%PDF")


def test_labels_name_every_sensor(refused):
    message = refused("simulate case.toml --plot --labels one")
    assert message == "--labels names 1 sensor; the case has 2"


def test_film_needs_ffmpeg(run, refused, folder, monkeypatch):
    """A stand-in for ffmpeg notes its arguments and the bytes of the frames."""
    monkeypatch.setenv("PATH", str(folder))
    message = refused("simulate case.toml --animate out.mp4")
    assert message == (
        "out.mp4: .mp4 files need the program ffmpeg, which is not installed; write a .gif"
    )
    script = f"#!{sys.executable}\nimport sys\n"
    script += "open(sys.argv[-1], 'w').write(f'{sys.argv[1:]} {len(sys.stdin.buffer.read())}')\n"
    (folder / "ffmpeg").write_text(script)
    (folder / "ffmpeg").chmod(0o755)
    films_of(4, monkeypatch)
    run("simulate case.toml --animate out.mp4 --size 2x2in --set run.duration=0.1")
    written = (folder / "out.mp4").read_text()
    assert "'180x180'" in written and written.endswith(str(4 * 180 * 180 * 3))


def test_what_looks_wrong_is_said_before_a_run(run, folder, capsys):
    found = run("check case.toml --json")
    assert found["first_frequency"] == pytest.approx(frequency(1))
    assert found["warnings"] == []
    assert "nothing looks wrong" in run("check case.toml")
    for command in ("simulate case.toml", "sweep case.toml --over loads.0.mass=0.1,0.5"):
        lines = run(command).splitlines()
        assert lines[0].startswith("plausibility: first frequency 20.39 Hz")
    for command in ("check", "simulate", "sweep --over loads.0.speed=0.5,1"):
        name, *more = command.split()
        with pytest.raises(SystemExit):
            main([name, "case.toml", *more, "--set", "run.duration=1.5", "--set", "loads.0.mass=9"])
        printed = capsys.readouterr()
        assert printed.err.count("jaxbeam: warning: loads.0.mass: the loads on the beam have") == 1
        assert "written" not in printed.out


def test_units_on_the_command_line(run, capsys):
    options = ["--set", "beam.length=600 mm", "--set", "beam.damping_ratio=1 %,2 %,3 %", "--json"]
    with pytest.raises(SystemExit):
        main(["modes", "case.toml", *options])
    found = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(found["damping_ratios"], [0.01, 0.02, 0.03], rtol=1e-9)
    assert found["frequencies_hz"][0] == pytest.approx(frequency(1))
    for over in ("3.6 km/h:7.2 km/h:3", "3.6 km/h,1.5 m/s,200 cm/s"):
        with pytest.raises(SystemExit):
            main(["sweep", "case.toml", "--over", f"loads.0.speed={over}", "--json"])
        values = json.loads(capsys.readouterr().out)["values"]["loads.0.speed"]
        np.testing.assert_allclose(values, [1.0, 1.5, 2.0], rtol=1e-12)
    with pytest.raises(SystemExit):
        main(["sweep", "case.toml", "--over", "loads.0.speed=3 km/h:7 m/s:3"])
    assert "both ends of a range have the same unit" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["simulate", "case.toml", "--set", "loads.0.mass=5 N"])
    assert "loads.0.mass must be in kg, or a unit of the same kind" in capsys.readouterr().err


def test_a_case_is_described_in_numbers(run):
    printed = run("describe case.toml")
    assert "beam of 0.6 m, pinned-pinned: E I = 11.68 N m², 0.535 kg/m" in printed
    assert f"natural frequencies (Hz): {frequency(1):.5g}, {frequency(2):.5g}" in printed
    assert f"critical speed: {2 * 0.6 * frequency(1):.4g} m/s" in printed


def test_a_record_as_a_table(run, folder):
    assert "written: out.csv" in run("simulate case.toml -o out.csv")
    heads, *rows = (folder / "out.csv").read_text().splitlines()
    assert heads.split(",")[:2] == ["time (s)", "sensor 0 deflection (m)"]
    assert len(rows) == 201


def test_modes_as_a_table(run, folder):
    assert "written: modes.csv" in run("modes case.toml -o modes.csv")
    table = np.loadtxt(folder / "modes.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 0], [1, 2, 3])
    np.testing.assert_allclose(table[:, 1], [frequency(n) for n in (1, 2, 3)], rtol=1e-9)
    np.testing.assert_allclose(table[:, 2], 0.03, rtol=1e-9)


def test_assess_cites_clauses(run, refused, folder):
    """A bridge of 25 m and 7.1 Hz at 108 km/h needs no dynamic analysis."""
    bridge = "--set beam.length=25 --set beam.flexural_rigidity=1.2e11"
    bridge += " --set beam.mass_per_length=15000"
    line = f"assess case.toml {bridge} --line-speed 30 --code en1991-2"
    assert "EN 1991-2, annex C" in run(f"{line} -o report.md")
    assert (folder / "report.md").read_text().startswith("# one span, one ball")
    found = run(f"{line} --json")
    assert "not required" in {check["outcome"] for check in found["checks"]}
    assert "track cannot be 'gravel'" in refused(f"{line} --track gravel")
    assert "spread cannot be 'wide'" in refused(f"{line} --spread wide")
    inputs = run(f"{line} --spread 2.4m --json")["inputs"]
    assert inputs["spread of axles"] == "Track(spread_length=2.4 m)"
    assert "ask for the dynamic analysis" in refused(f"{line} --track maintained --plot")
    assert "line_speed takes a number in m/s" in refused("assess case.toml --line-speed fast")


def test_influence_lines_as_a_table(run, refused, folder):
    printed = run("influence case.toml -o lines.csv --plot")
    assert "moment at midspan 1" in printed and (folder / "lines.png").exists()
    assert "e-1" not in printed  # round-off of a load over a support
    heads, *rows = (folder / "lines.csv").read_text().splitlines()
    assert heads.split(",")[1] == "moment at midspan 1 (m)"
    assert max(float(row.split(",")[1]) for row in rows) == pytest.approx(0.6 / 4)
    found = run("influence case.toml --quantity shear --at 150mm --json")
    assert max(found["shear at quarter 1 (1)"]) == pytest.approx(0.75, abs=0.02)
    assert "did you mean 'reaction'" in refused("influence case.toml --quantity reactions")
    assert "--at takes a number in m" in refused("influence case.toml --at middle")


def test_an_accelerometer_is_not_reported_as_deflection(run):
    line = "case.toml --set sensors.1.quantity=acceleration --set sensors.1.name=deck"
    found = run(f"simulate {line} --json")
    assert found["peak_deflection"][1] is None and found["peak_deflection"][0] > 0
    deck = found["sensors"][1]
    assert (deck["name"], deck["quantity"], deck["unit"]) == ("deck", "acceleration", "m/s^2")
    printed = run(f"simulate {line}")
    assert "acceleration (m/s^2)" in printed and f"{deck['largest']:.6g}" in printed
    assert "peak deflection" not in printed
    swept = run(f"sweep {line} --over loads.0.mass=0.1,0.5 --json")
    assert np.isfinite(np.array(swept["peak_acceleration"], float)[:, 1]).all()
    assert np.isnan(np.array(swept["peak_deflection"], float)[:, 1]).all()
    assert "deck  acceleration (m/s^2)" in run(f"sweep {line} --over loads.0.mass=0.1,0.5")


def test_simulate_overwrites_only_with_the_option(run, refused, folder):
    run("simulate case.toml -o out.nc")
    first = (folder / "out.nc").read_bytes()
    assert "out.nc exists" in refused("simulate case.toml -o out.nc --set loads.0.mass=0.1")
    assert (folder / "out.nc").read_bytes() == first
    run("simulate case.toml -o out.nc --set loads.0.mass=0.1 --overwrite")
    assert (folder / "out.nc").read_bytes() != first


def test_sweep_agrees_with_single_runs(run, refused, folder):
    line = "sweep case.toml --over loads.0.mass=0.1,0.5 --over loads.0.speed=0.5:1.5:3"
    found = run(f"{line} --json -o out.zarr")
    assert found["dimensions"] == ["loads.0.mass", "loads.0.speed", "sensor"]
    assert found["values"]["loads.0.speed"] == [0.5, 1.0, 1.5]
    peaks = np.array(found["peak_deflection"])
    assert peaks.shape == (2, 3, 2)
    for (i, mass), (j, speed) in itertools.product(enumerate([0.1, 0.5]), enumerate([0.5, 1, 1.5])):
        one = run(
            f"simulate case.toml --json --set loads.0.mass={mass} --set loads.0.speed={speed}"
        )
        np.testing.assert_allclose(peaks[i, j], one["peak_deflection"], rtol=2e-6)
    assert "out.zarr exists" in refused(f"{line} -o out.zarr")
    again = run(f"{line} --json -o out.zarr --resume")
    assert again == found
    assert f"{peaks[..., 0].max():.6g}" in run(line)


def test_frequency_responses(run, folder):
    """Resonance of one mode with a stationary mass at midspan: w^2 = k / (m + M)."""
    words = "frf case.toml --set beam.modes=1 --from 2 --to 60 --points 400"
    found = run(f"{words} --json --mass-at 0.3=0.5 --pair force@0.3:velocity@0.3")
    (response,) = found["responses"]
    assert (response["input"], response["output"]) == ("force@0.3", "velocity@0.3")
    assert response["unit"] == "(m/s)/N"
    loaded = frequency(1) / math.sqrt(1 + 0.5 / (0.535 * 0.6 / 2))
    peak = found["frequencies_hz"][int(np.argmax(response["magnitude"]))]
    np.testing.assert_allclose(peak, loaded, rtol=1e-2)
    assert len(response["phase_deg"]) == 400
    printed = run(f"{words} --plot -o out.nc")
    assert "force@0.3 -> sensors.0, in m/N" in printed
    assert " peak " in printed
    assert "written: out.nc" in printed
    assert (folder / "out.nc").stat().st_size > 0
    assert (folder / "out.png").read_bytes().startswith(b"\x89PNG")


def test_sweep_prints_where_peaks_are_and_writes_rows(run, folder):
    """Largest and smallest peak of a sensor, as the rows of the file have them."""
    line = "sweep case.toml --over loads.0.speed=0.5,1,2 -o out.csv"
    printed = run(line)
    heads, *rows = (row.split(",") for row in (folder / "out.csv").read_text().splitlines())
    assert heads[:2] == ["speed of the load (m/s)", "sensor 0 peak deflection (m)"]
    peaks = {float(row[1]): row[0] for row in rows}
    for words, peak in (("largest", max(peaks)), ("smallest", min(peaks))):
        found = [one.split() for one in printed.splitlines() if one.split()[:1] == ["0"]]
        (own,) = [row for row in found if words in row]
        assert own[-3] == f"{peak:.6g}" and float(own[-1]) == float(peaks[peak])
    least = min(float(row[heads.index("load 0 lowest contact force (N)")]) for row in rows)
    assert f"smallest contact force {least:.6g} N, at speed of the load " in printed
    assert "no run loses contact" in printed


def test_prescribed_forces_pull_as_given_and_lose_no_contact(run, folder):
    (folder / "pull.toml").write_text(
        """
        beam = {length = 20.0, flexural_rigidity = 5e9, mass_per_length = 8e3}
        sensors = [{position = 10.0}]
        run = {duration = 2.5}
        [[loads]]
        kind = "varying-force"
        force = 1e4
        frequencies = [3.0]
        amplitudes = [2e4]
        phases = [0.0]
        speed = 10.0
        """
    )
    printed = run("sweep pull.toml --over loads.0.speed=10,12")
    assert "contact" not in printed
    printed = run("simulate pull.toml")
    assert "is negative at times, down to -1e+04 N, as given" in printed
    assert "pulls, as given" in printed and "would lift" not in printed


def test_fractiles_of_a_sweep_over_seeds(run, folder):
    """Of three seeds the median is the middle one; what is written is whole."""
    profile = "--set profile.kind=iso8608 --set profile.class=A --set profile.scale=0.02"
    profile += " --set profile.highest_wavenumber=1"
    line = f"sweep case.toml {profile} --over profile.seed=1,2,3 -o out.nc"
    said = run(f"{line} --fractile profile.seed=0.5,1 --over loads.0.speed=1,2 --plot")
    with xarray.open_dataset(folder / "out.nc") as found:
        peaks = found.peak_deflection.values[..., 0]
    assert peaks.shape == (3, 2)
    for name, largest in (("50 %", np.sort(peaks, axis=0)[1].max()), ("100 %", peaks.max())):
        assert any(name in row and f"{largest:.6g}" in row for row in said.splitlines())
    assert (folder / "out.png").exists()
    median = next(row for row in said.splitlines() if "50 %" in row)
    assert "-inf to inf" in median and median.split()[-1] == "3"  # six are the least
    (folder / "out.png").unlink()
    found = run(f"{line} --overwrite --fractile profile.seed=0.5 --plot --json")
    assert np.shape(found["statistics"][0]["peak_deflection"]) == (8, 2)
    assert (folder / "out.png").exists()  # a histogram


def test_paired_sweep(run):
    line = "sweep case.toml --over loads.0.mass=0.1,0.5 --over loads.0.speed=0.5,1 --paired"
    peaks = np.array(run(f"{line} --json")["peak_deflection"])
    assert peaks.shape == (2, 2)
    limit = np.sort(peaks.max(axis=1)).mean()  # between the largest peaks of the two runs
    said = run(f"{line} --limit deflection={limit}")
    assert "2 runs" in said and f"deflection is above {limit:g} m in 1 of 2 runs" in said


def test_sweep_over_words(run, refused, folder):
    """Trains are words; the picture has their peaks over speed."""
    load = '[[loads]]\nkind = "axles"\ntrain = "HL93-tandem"\nspeed = 1.0\n'
    text = CASE[: CASE.index("[[loads]]")] + load
    for old, new in {"= 0.6": "= 9.0", "11.68": "1e8", "0.535": "535.0"}.items():
        text = text.replace(old, new)
    (folder / "train.toml").write_text(text)
    line = "sweep train.toml --over loads.*.speed=20:40:3 --over loads.0.train="
    found = run(f"{line}HL93-tandem,LM71-axles --plot --json")
    assert found["dimensions"] == ["loads.*.speed", "loads.0.train", "sensor"]
    assert found["values"]["loads.0.train"] == ["HL93-tandem", "LM71-axles"]
    assert np.shape(found["peak_deflection"]) == (3, 2, 2)
    assert (folder / "train_sweep.png").read_bytes().startswith(b"\x89PNG")
    assert "train_sweep.png exists" in refused(f"{line}HL93-tandem,LM71-axles --plot")
    printed = run(f"{line}HL93-tandem,LM71-axles")
    assert "6 runs" in printed and "LM71-axles" in printed
    assert "did you mean 'LM71-axles'" in refused(f"{line}LM71-axle")
    message = refused("sweep train.toml --over loads.*.speed=20 --plot")
    assert "one or two parameters with several values" in message


def write_decay(path):
    """Write the log of a free decay: 12 Hz with damping ratio 0.01, 31 Hz with 0.02, and noise."""
    times = np.arange(4000) / 400.0
    signal = 1e-6 * np.random.default_rng(0).standard_normal(times.size)
    for hertz, ratio, size in ((12.0, 0.01, 1.0), (31.0, 0.02, 0.5)):
        undamped = 2 * math.pi * hertz
        wave = np.sin(undamped * math.sqrt(1 - ratio**2) * times)
        signal += size * 1e-3 * np.exp(-ratio * undamped * times) * wave
    rows = "".join(f"{t:.6f},{x:.9e}\n" for t, x in zip(times, signal, strict=True))
    path.write_text("time [s],w [m]\n" + rows)


def test_identify_modes_of_a_decay(run, folder):
    write_decay(folder / "decay.csv")
    printed = run("identify decay.csv --plot")
    assert "12.0" in printed
    assert (folder / "decay.png").exists()
    assert list(run("identify decay.csv --json")) == ["decay.csv"]


def test_identify_a_case(run, folder):
    import jaxbeam as jb

    record = jb.simulate(load_case(folder / "case.toml"))
    table = np.column_stack([record.times, np.asarray(record.deflection)[:, 0]])
    rows = "".join(f"{t:.6f},{x:.9e}\n" for t, x in table)
    (folder / "log.csv").write_text("time [s],w [m]\n" + rows)
    (folder / "log.toml").write_text("[columns]\nw = { unit = 'm', sensor = 0 }\n")
    run(
        "identify case.toml log.csv --set beam.flexural_rigidity=10"
        " --free beam.flexural_rigidity=0.005kN*m^2:20N*m^2 -o fit.toml --plot"
    )
    fitted = load_case(folder / "fit.toml")
    np.testing.assert_allclose(fitted.beam.bending_stiffness, 11.68, rtol=1e-4)
    assert (folder / "fit.png").exists()


def test_contact_loss_is_printed_once(run):
    printed = run("simulate case.toml --set loads.0.speed=6 --set loads.0.mass=3")
    assert printed.count("load 0 loses contact") == 1
    assert "lowest on the beam (N)  largest at samples (N)  unloading in the run" in printed


def test_wheels_are_named_by_what_they_are_chosen_for(folder, run):
    """Of two trucks the wheel unloaded most, that of the lowest and that of the largest force."""
    (folder / "trucks.toml").write_text(TRUCKS)
    found = run("simulate trucks.toml --json")
    weights = np.asarray(load_set(load_case(folder / "trucks.toml")).weight)[:, 0]
    lowest, unloading = (np.array(found[n]) for n in ("lowest_contact_force", "wheel_unloading"))
    largest = np.array(found["largest_contact_force"])
    expected = {"most unloaded": unloading, "lowest force": -lowest, "largest force": largest}
    assert np.argmax(unloading) != np.argmin(lowest)
    printed = [line for line in run("simulate trucks.toml").splitlines() if " of 10 " in line]
    for words, values in expected.items():
        wheel = int(np.argmax(values))
        (line,) = (line for line in printed if f"0 wheel {wheel + 1}, " in line)
        assert words in line
        numbers = [float(text) for text in line.split(" of 10 ")[1].split()[:3]]
        own = weights[wheel], lowest[wheel], largest[wheel]
        np.testing.assert_allclose(numbers, own, rtol=1e-5)


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("simulate", 2),  # an argument is missing
        ("simulate case.toml more.toml", 2),
        ("simulate case.toml --unknown", 2),
        ("simulate case.toml --dpi fine", 2),
        ("simulate case.toml --set loads.0.speed", 2),
        ("sweep case.toml --over loads.0.speed=1:2", 2),
        ("sweep case.toml --over loads.0.speed=1,2 --resume", 2),
        ("fly case.toml", 2),
        ("simulate absent.toml", 1),  # what the words name is wrong
        ("simulate case.toml --set loads.0.speed=0", 1),
        ("simulate case.toml --set beam.heigth=1", 1),
    ],
)
def test_the_status_tells_wrong_usage_from_wrong_input(folder, capsys, line, status):
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert (ended.value.code, capsys.readouterr().out) == (status, "")
