"""A mock PLC: what TwinCAT with the contract of `hil` answers over ADS."""
