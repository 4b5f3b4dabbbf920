"""Events of sampled loops in C: the commands of the simulated loop, under sanitizers."""

import dataclasses
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxbeam.integrator.inputs import StepInfo
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.c_writer import UntranslatedError
from jaxbeam.runtime.native_library import C_FOLDER, find_compiler
from jaxbeam.simulation.closed_loop import closed_loop, loop_schedule
from jaxbeam.simulation.integration_plan import sample_times
from jaxbeam.sweeps.native_integration import translated_loops
from tests.c_code.cases import CASES

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")

SANITIZED = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
EVENTS = 40
REFUSED = {"kalman-extended": "accelerations"}


def loop_of(case):
    """Sampled loop of a case."""
    schedule = loop_schedule(case, np.asarray(sample_times(case)), float(case.run.duration))
    layout = mesh_layout(case)
    return closed_loop(case, layout, load_set(case, layout), schedule)


def commands_in_c(translated, times, states, actuators, folder) -> np.ndarray:
    """Commands (event, actuator, run) under states, and of a loop whose readings stay at rest."""
    (folder / "program.c").write_text(translated.text)
    harness = Path(__file__).parents[1] / "native_loops.c"
    command = [find_compiler(), "-O0", "-Wall", "-Wno-unused", *SANITIZED, f"-I{C_FOLDER}"]
    files = [folder / "program.c", harness, "-o", folder / "program", "-lm"]
    subprocess.run([*command, *files], check=True)
    numbers = [struct.pack("q", len(translated.inputs))]
    for array in translated.inputs:
        numbers += [struct.pack("q", array.size), array.tobytes()]
    numbers += [struct.pack("q", translated.memory.size), translated.memory.tobytes()]
    numbers += [struct.pack("3q", len(times), states.shape[1], actuators)]
    for time, state in zip(times, states, strict=True):
        numbers += [struct.pack("d", time), state.tobytes()]
    (folder / "numbers").write_bytes(b"".join(numbers))
    run = [folder / "program", folder / "numbers"]
    ended = subprocess.run(run, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
    return np.array(ended.stdout.split(), float).reshape(len(times), actuators, 2)


@pytest.mark.parametrize("kind", [kind for kind in CASES if kind not in REFUSED])
def test_events_give_the_commands_of_the_loop(kind, tmp_path):
    loop = loop_of(CASES[kind])
    times = np.asarray(loop.schedule.times)[:EVENTS]
    rng, count = np.random.default_rng(4), loop.model.state_count
    states = 1e-4 * np.cumsum(rng.normal(size=(times.size, count)), axis=0)
    memory, expected = loop.start(2), []
    for event, (time, state) in enumerate(zip(times, states, strict=True)):
        both = np.stack([state, np.zeros(count)], axis=1)
        info = StepInfo(np.float64(time), np.float64(0), np.int64(event))
        memory = loop._process_event(memory, both, info)
        expected.append(np.asarray(loop.path.acting(memory.commands)))
    actuators = len(CASES[kind].actuators)
    found = commands_in_c(translated_loops([loop])[0], times, states, actuators, tmp_path)
    largest = np.max(np.abs(expected))
    assert_allclose(found, expected, rtol=0, atol=1e-12 * largest)


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_translated_is_named(kind):
    with pytest.raises(UntranslatedError, match=REFUSED[kind]):
        translated_loops([loop_of(CASES[kind])])


def test_loops_of_one_structure_share_their_code():
    """Numbers of the design, of the plant and of the schedule are arguments."""
    case, loops = CASES["pd"], [loop_of(CASES["mpc"])]
    for gain in (1.0, 2.0):
        controller = dataclasses.replace(case.controller, gains=gain * case.controller.gains)
        loops.append(loop_of(dataclasses.replace(case, controller=controller)))
    sensors = case.sensors[:2]  # as many numbers, of other parts
    for fine in (0, 1):
        one = [
            dataclasses.replace(s, resolution=1e-5 if i == fine else None)
            for i, s in enumerate(sensors)
        ]
        loops.append(loop_of(dataclasses.replace(case, sensors=one)))
    together, alone = translated_loops(loops), [translated_loops([loop])[0] for loop in loops]
    assert len({one.text for one in together}) == 4
    for one, other in zip(together, alone, strict=True):
        assert one.text == other.text
        assert_array_equal(one.memory, other.memory)
        for number, expected in zip(one.inputs, other.inputs, strict=True):
            assert_array_equal(number, expected)
    assert any(np.any(a != b) for a, b in zip(together[1].inputs, together[2].inputs, strict=True))
