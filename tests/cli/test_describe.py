"""`jaxbeam describe`: vehicles of files, of cases, of the library."""

import numpy as np
import pytest

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
