"""Mock robots with physically accurate simulation and real wire protocols."""
