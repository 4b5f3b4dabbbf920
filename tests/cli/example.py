"""Case file of the command-line tests."""

CASE = """
title = "one span, one ball"
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = 0.03
[[sensors]]
position = 0.3
[[sensors]]
position = 0.15
[[loads]]
kind = "mass"
mass = 0.5
speed = 1.0
[run]
duration = 1.0
sample_rate = 200.0
"""

CONTROLLED_CASE = """
[beam]
length = 0.6
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = 0.1
modes = 1
[[actuators]]
kind = "point"
position = 0.3
limits = [-20.0, 20.0]
[[sensors]]
position = 0.3
[[loads]]
kind = "mass"
mass = 0.5
speed = 1.0
[controller]
kind = "feedback"
gains = [100.0]
period = 0.005
[run]
duration = 0.6
sample_rate = 100.0
"""
