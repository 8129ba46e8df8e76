"""The parts of `hil.data.filters`: settings, low-pass filter, derivatives, down-sampling."""
