"""Mock PLC: a simulated TwinCAT PLC with the ADS contract of `hil`."""
