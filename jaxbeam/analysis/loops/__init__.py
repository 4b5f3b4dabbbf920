"""Loops of known numbers: of affine laws, and with stationary loads."""
