"""Command `modes-from-log`: options, choices with the options that override them, errors."""

import numpy as np
import pytest

from jaxbeam.files.case_file import load_case


@pytest.fixture
def decay_log(folder):
    """Log without headings: 12 Hz with damping ratio 0.01 in two channels, hum of 50 Hz, noise."""
    times = np.arange(1500) / 300
    wave = np.exp(2 * np.pi * 12 * times * (-0.01 + 1j))
    random = np.random.default_rng(0)
    values = np.stack([wave.real, -0.5 * wave.real], axis=1)
    values += 0.05 * np.cos(2 * np.pi * 50 * times)[:, None] + 0.01 * random.normal(size=(1500, 2))
    np.savetxt(folder / "node.csv", np.column_stack([times, values]), delimiter=",", fmt="%.6f")
    return folder


COLUMNS = "--columns t[s],a[g],b[g]"


def test_a_stabilisation_diagram_is_a_page(run, refused, decay_log):
    line = f"modes-from-log node.csv {COLUMNS} --band 5:60 --html"
    assert "written: node.html" in run(f"{line} --method covariance")
    assert "jaxbeam modes-from-log node.csv --band 5:60" in (decay_log / "node.html").read_text()
    assert "node.html exists" in refused(line)


def test_modes_of_a_file_without_headings(run, decay_log):
    printed = run(f"modes-from-log node.csv {COLUMNS} --band 5:60 --plot --length 2")
    assert "excitation: a free decay  [--kind" in printed and "50.00" in printed
    assert (decay_log / "node.png").read_bytes().startswith(b"\x89PNG")
    found = run(f"modes-from-log node.csv {COLUMNS} --band 5:60 --json")
    np.testing.assert_allclose(found["frequencies_hz"], [12], rtol=1e-3)
    np.testing.assert_allclose(found["damping_ratios"], [0.01], rtol=0.05)
    np.testing.assert_allclose(found["modes"][0]["shape_real"], [1, -0.5], atol=0.01)
    assert {choice["option"].split()[0] for choice in found["choices"]} >= {"--kind", "--order"}
    part = run(
        f"modes-from-log node.csv {COLUMNS} --band 5:60 --from 0.5 --to 4 --channels b --order 10"
        " --exclude 50 --count 1 --json"
    )
    assert part["channels"] == ["b"] and part["window_s"][0] == pytest.approx(0.5)
    np.testing.assert_allclose(part["frequencies_hz"], [12], rtol=2e-3)


def test_modes_that_the_user_chooses(run, decay_log):
    """One of two that are well identified without a choice."""
    rows = np.loadtxt(decay_log / "node.csv", delimiter=",")
    wave = np.exp(2 * np.pi * 21 * rows[:, 0] * (-0.01 + 1j)).real
    rows[:, 1:] += np.multiply.outer(wave, [1.0, 0.7])
    np.savetxt(decay_log / "two.csv", rows, delimiter=",", fmt="%.6f")
    line = f"modes-from-log two.csv {COLUMNS} --band 5:60 --json"
    np.testing.assert_allclose(run(line)["frequencies_hz"], [12, 21], rtol=1e-3)
    np.testing.assert_allclose(run(f"{line} --choose 20.9")["frequencies_hz"], [21], rtol=1e-3)


def test_a_measured_force(run, refused, decay_log):
    """The first column is an impact of a hammer, in N by the unit given to it."""
    rows = np.loadtxt(decay_log / "node.csv", delimiter=",")
    rows[:, 1] = np.arange(1500) == 0
    np.savetxt(decay_log / "hammer.csv", rows, delimiter=",", fmt="%.6f")
    line = "modes-from-log hammer.csv --columns t[s],f[N],b[g] --band 5:40"
    found = run(f"{line} --force f --json")
    assert (found["kind"], found["method"]) == ("measured force", "plscf")
    np.testing.assert_allclose(found["frequencies_hz"], [12], rtol=1e-3)
    np.testing.assert_allclose(found["damping_ratios"], [0.01], rtol=0.05)
    assert found == run(f"{line} --json"), "a channel in N is a force"
    drawn = run(f"{line} --responses Hv --exponential 0.5 --force-window 0.1")
    assert "written: hammer_responses.png" in drawn
    assert (decay_log / "hammer_responses.png").stat().st_size > 10_000
    assert "--responses takes H1, H2 or Hv" in refused(f"{line} --responses H3")
    assert "--exponential is for --responses" in refused(f"{line} --exponential 0.5")


def test_the_rate_of_a_file_without_times(run, decay_log):
    rows = np.loadtxt(decay_log / "node.csv", delimiter=",")[:, 1:]
    np.savetxt(decay_log / "untimed.csv", rows, delimiter=";", fmt="%.6f")
    found = run("modes-from-log untimed.csv --columns a[g],b[g] --rate 300 --band 5:60 --json")
    np.testing.assert_allclose(found["frequencies_hz"], [12], rtol=1e-3)


def test_a_case_is_fitted_to_the_modes(run, decay_log):
    """E I = m L^4 (2 pi f)^2 / pi^4 of the pinned beam, within its interval."""
    (decay_log / "beam.toml").write_text(
        "[beam]\nlength = 3.0\nflexural_rigidity = 9e4\nmass_per_length = 20.0\nmodes = 2\n"
    )
    line = f"modes-from-log node.csv {COLUMNS} --band 5:60 --case beam.toml"
    printed = run(f"{line} --free beam.flexural_rigidity=5e4:5e5 -o fitted.toml")
    assert "mode 1 of the case: 12.0" in printed and "written: fitted.toml" in printed
    expected = 20 * 3**4 * (2 * np.pi * 12) ** 2 / np.pi**4
    assert load_case(decay_log / "fitted.toml").beam.flexural_rigidity == pytest.approx(
        expected, rel=2e-3
    )
    found = run(f"{line} --free beam.flexural_rigidity --json")["fit"]
    low, high = found["numbers"]["beam.flexural_rigidity"]["interval_95"]
    assert low < expected < high < 1.02 * low


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "modes-from-log needs a log"),
        ("nothing.csv", "nothing.csv: there is no such log file"),
        ("node.csv", "node.csv, line 1: the file has no headings; name its 3 columns"),
        (f"node.csv {COLUMNS} --band 5", "--band takes LOW:HIGH in Hz, such as 5:45, not '5'"),
        (f"node.csv {COLUMNS} --band 5:600", "not within 0 and half the sampling rate, 150 Hz"),
        (f"node.csv {COLUMNS} --exclude x", "--exclude takes frequencies in Hz"),
        (f"node.csv {COLUMNS} --choose 0", "--choose takes frequencies in Hz"),
        (f"node.csv {COLUMNS} --choose 12 --count 1", "chosen modes are all that are kept; leave"),
        (f"node.csv {COLUMNS} --choose 90", "no pole within 2 % of the chosen 90 Hz; the nearest"),
        (f"node.csv {COLUMNS} --from 3 --to 2", "--from must be less than --to"),
        (f"node.csv {COLUMNS} --from 90 --to 95", "has no part from 90 to 95 s: change --from"),
        (f"node.csv {COLUMNS} --to -1", "has no part from 0 to -1 s"),
        (f"node.csv {COLUMNS} --channels c", "the log has no channel 'c'; it has a, b"),
        (f"node.csv {COLUMNS} --method x", "method must be"),
        (f"node.csv {COLUMNS} --method fdd", "method 'fdd' is gone: other methods find more modes"),
        (f"node.csv {COLUMNS} --force b", "channel 'b' is in g, which is no force"),
        (f"node.csv {COLUMNS} --force a --method data", "used by method 'plscf', not by 'data'"),
        (f"node.csv {COLUMNS} --order 2", "the highest order must be from 4 to 1000, not 2"),
        (f"node.csv {COLUMNS} --free beam.length", "--case and --free belong together"),
        (f"node.csv {COLUMNS} -o out.toml", "-o writes the fitted case: give --case"),
        (f"node.csv {COLUMNS} --rate 100", "the log has a column of times, 't'"),
    ],
)
def test_mistakes(refused, decay_log, line, message):
    assert message in refused(f"modes-from-log {line}")


def rove(folder, name, moved, seed):
    """Log of a decay of 12 Hz at a sensor that stays and at one that moves, of some size there."""
    times = np.arange(1500) / 300
    wave = np.exp(2 * np.pi * 12 * times * (-0.01 + 1j)).real
    values = np.multiply.outer(wave, [1.0, moved])
    values += 0.01 * np.random.default_rng(seed).normal(size=values.shape)
    np.savetxt(
        folder / name, np.column_stack([times, values]), delimiter=",", fmt="%.6f", comments="",
        header="t [s],stays [g],moves [g]",
    )  # fmt: skip


def test_setups_of_a_sensor_that_moves(run, refused, folder):
    rove(folder, "one.csv", 0.5, 1)
    rove(folder, "two.csv", -0.4, 2)
    line = "modes-from-log one.csv two.csv --band 5:60"
    printed = run(f"{line} --references stays --plot --length 3")
    assert "2 setups: one.csv, two.csv" in printed and "moves of two" not in printed
    for name in ("one_setup1.png", "one_setup2.png", "one_setups.png"):
        assert (folder / name).stat().st_size > 10_000 and f"written: {name}" in printed
    found = run(f"{line} --references stays --json")
    assert found["channels"] == ["stays", "moves of one", "moves of two"]
    np.testing.assert_allclose(found["modes"][0]["shape_real"], [1, 0.5, -0.4], atol=0.01)
    np.testing.assert_allclose(found["frequencies_hz"], [12], rtol=1e-3)
    # Without references they are records of the same channels.
    assert "setups" not in run(f"{line} --json")
    assert "2 logs of the same channels, used together  [--references" in run(line)
    # Positions of the descriptions tell the same, and where the sensors are.
    for stem, place in (("one", 1.0), ("two", 2.5)):
        (folder / f"{stem}.toml").write_text(
            f"[columns]\nstays = {{ position = 0.5 }}\nmoves = {{ position = {place} }}\n"
        )
    told = run(f"{line} --json")
    assert told["channels"] == ["stays", "moves at 1 m", "moves at 2.5 m"]
    assert told["positions_m"] == [0.5, 1.0, 2.5] and told["references"] == ["stays"]
    part = run(f"{line} --references stays --channels stays,moves --from 0.5 --json")
    assert [one["window_s"][0] >= 0.5 for one in part["setups"]] == [True, True]
    refused_line = refused("modes-from-log one.csv --references stays")
    assert "references connect several setups, and this is one log" in refused_line
    assert "no channel 'mast', which is to be a reference" in refused(f"{line} --references mast")
    assert "exists; choose another name" in refused(f"{line} --references stays --plot")
    text = (folder / "two.csv").read_text().replace("stays", "left").replace("moves", "right")
    (folder / "other.csv").write_text(text)
    refused_line = refused("modes-from-log one.csv other.csv --band 1:900")
    assert "other.csv: no channel is common with one.csv" in refused_line, "before any work"


def test_a_case_is_fitted_to_modes_of_setups(run, folder):
    """E I = m L^4 (2 pi f)^2 / pi^4 of the pinned beam, within its interval."""
    for name, place, seed in (("one", 1.0, 1), ("two", 2.5, 2)):
        rove(folder, f"{name}.csv", np.sin(np.pi * place / 3.0), seed)
        (folder / f"{name}.toml").write_text(
            f"[columns]\nstays = {{ position = 1.5 }}\nmoves = {{ position = {place} }}\n"
        )
    (folder / "beam.toml").write_text(
        "[beam]\nlength = 3.0\nflexural_rigidity = 9e4\nmass_per_length = 20.0\nmodes = 2\n"
    )
    line = "modes-from-log one.csv two.csv --band 5:60 --case beam.toml"
    found = run(f"{line} --free beam.flexural_rigidity --json")["fit"]
    truth = 20.0 * 3.0**4 * (2 * np.pi * 12) ** 2 / np.pi**4
    low, high = found["numbers"]["beam.flexural_rigidity"]["interval_95"]
    assert low <= truth <= high and high - low < 0.01 * truth
    assert found["pairs"][0]["mac"] > 0.999
