"""Dwell programs and Fourier excitation."""
