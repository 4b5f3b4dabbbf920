"""Least achievable peak deflection: influence of the commands, and a linear program."""
