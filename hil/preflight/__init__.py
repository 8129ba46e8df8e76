"""Checks before motion."""
