"""Internal-model control: feedback of the deflection due to the load, without that by commands."""
