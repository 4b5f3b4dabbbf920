"""Library of published vehicles and trains: data files with their sources, read by name.

`trains/` has axle loads in rows, `models/` vehicles with suspensions in the format of vehicle files
(see `jaxbeam.case.loads.vehicles`). Every file names the source of its numbers.
"""
