"""Rigid-body dynamics over Pinocchio."""
