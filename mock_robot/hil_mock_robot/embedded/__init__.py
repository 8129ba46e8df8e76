"""The embedded mock: a robot inside the process that uses it (station: `driver: mock`)."""
