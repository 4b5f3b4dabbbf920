"""Forces that move at constant speeds, in closed form."""
