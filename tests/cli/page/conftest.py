"""A page of a folder with one case, in a browser of the system without a window."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

RIG = """# A rig of two spans, for tests of the page.
title = "Rig of two spans"

[beam]
length = 1.2                  # m
flexural_rigidity = 12.0      # N m^2
mass_per_length = 0.5         # kg/m
damping_ratio = 0.02

[[supports]]
position = 0.6                # the pier

[[sensors]]
name = "first span"
position = 0.3

[[loads]]
kind = "mass"
mass = 0.4                    # kg
speed = "3.6 km/h"

[run]
duration = 1.3
sample_rate = 500.0
"""
SHAKER = """# Shaker in an inner loop with limits of voltage: no peak can be proved the least.
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
modes = 2

[[actuators]]
kind = "electrodynamic"
position = 0.35
resistance = 0.82
inductance = 5e-3
force_constant = 4.2
back_emf = 3.9
mass = 0.03
stiffness = 900.0
damping = 0.55
limits = [-0.2, 0.3]

[actuators.inner_loop]
kind = "current"
bandwidth = 900.0

[[sensors]]
position = 0.3

[[loads]]
kind = "mass"
mass = 0.1
speed = 6.0

[controller]
kind = "feedback"
gains = [1e3]
period = 0.01

[run]
duration = 0.12
"""
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def decay(folder):
    """Log of two modes that decay, 4 Hz in phase and 11 Hz in antiphase at two channels."""
    times = np.arange(1200) / 100
    slow, fast = (
        np.exp(-2 * np.pi * f * 0.01 * times) * np.cos(2 * np.pi * f * times) for f in (4, 11)
    )
    noise = 1e-2 * np.random.default_rng(2).normal(size=(2, times.size))
    columns = np.stack([times, slow + fast + noise[0], slow - fast + noise[1]], axis=1)
    path = folder / "ring.csv"
    np.savetxt(path, columns, delimiter=",", header="time [s],a1 [m/s^2],a2 [m/s^2]", comments="")
    return path


@pytest.fixture
def workspace(rig):
    """The folder of a rig, opened."""
    from jaxbeam.cli.page.workspace import Workspace

    opened = Workspace(rig.parent)
    yield opened
    opened.close()


class Server:
    """The command `jaxbeam app` for a file, in a process of its own."""

    def __init__(self, path, port=0):
        self.path = path
        line = [sys.executable, "-m", "jaxbeam", "app", str(path), "--no-browser", "--port", port]
        self._process = subprocess.Popen([*map(str, line)], stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.address = self._process.stdout.readline().strip()
        self.port = int(self.address.split(":")[2].split("/")[0])

    def stop(self):
        """Kill it, as a crash would."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


@pytest.fixture
def rig(tmp_path):
    """Path of the case file of a rig in a folder of its own."""
    path = tmp_path / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def module_server(tmp_path_factory):
    """The page of a folder with the rig, for all tests of a file, as it takes seconds to start."""
    path = tmp_path_factory.mktemp("page") / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    running = Server(path)
    yield running
    running.stop()


@pytest.fixture
def server(module_server):
    """The page of a folder with the rig alone."""
    for path in module_server.path.parent.iterdir():
        path.unlink()
    module_server.path.write_text(RIG, encoding="utf-8")
    return module_server


@pytest.fixture(scope="session")
def browser():
    """Chromium of the system."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        options = ["--no-sandbox", "--disable-background-networking"]
        running = play.chromium.launch(executable_path=CHROMIUM, args=options)
        yield running
        running.close()


@pytest.fixture
def page(browser, server):
    """The page of the rig in the browser, ready; what goes wrong in it fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, accept_downloads=True)
    opened = context.new_page()
    wrong, asked = [], []
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("request", lambda request: asked.append(request.url))
    go(opened, server.address)
    yield opened
    context.close()
    assert wrong == []
    local = (f"http://127.0.0.1:{server.port}/", "blob:", "data:")
    assert [url for url in asked if not url.startswith(local)] == []


def go(page, address):
    """Open an address, and wait until its run is shown."""
    page.goto(address)
    page.wait_for_selector("body[data-ready]")
    page.wait_for_selector(".plot canvas")
