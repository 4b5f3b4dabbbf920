"""Planar vehicles of any bodies, springs, dampers, hinges and axles: files, checks, matrices."""
