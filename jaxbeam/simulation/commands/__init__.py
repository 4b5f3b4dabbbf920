"""Commands on their way from the law to the beam: limits, hysteresis and its inverse."""
