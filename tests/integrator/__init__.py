"""Tests of integrator."""
