"""Embedded mock: a simulated robot inside the process that uses it (station: `driver: mock`)."""
