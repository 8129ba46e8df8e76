"""Drivers for real robots."""
