"""MCAP recording, columnar reading and the run directory."""
