"""Modes (natural frequencies, damping ratios) identified from logs of unknown excitation."""
