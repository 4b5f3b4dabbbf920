"""Integrator: exact modal propagation with contact forces collocated at Gauss nodes."""
