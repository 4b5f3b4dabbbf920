"""Modes after blows that were not measured, from whole records."""
