"""People on the beam: the forces of their steps, pedestrians, crowds."""
