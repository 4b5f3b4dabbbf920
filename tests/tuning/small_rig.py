"""A small rig with a patch, for tests of controller tuning."""

import jaxbeam as jb

GAIN = "controller.gains.0"
RIGIDITY = "beam.flexural_rigidity"
BEAM = jb.Beam(
    length=0.6, flexural_rigidity=13.211, mass_per_length=0.812, damping_ratio=0.03, modes=1
)


def rig(controller=None) -> jb.Case:
    """One mode, a patch, a sensor, a load that crosses in 0.4 s; linear feedback if left out."""
    return jb.Case(
        BEAM,
        actuators=[
            jb.Patch(
                0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0, limits=[-2.5, 7.5]
            )
        ],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.5, speed=1.5)],
        controller=jb.Feedback([2000.0], period=0.01) if controller is None else controller,
        run=jb.Run(duration=0.5, sample_rate=100.0),
    )
