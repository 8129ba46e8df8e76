"""Arms behind a Beckhoff PLC, by ADS: the PLC owns the cycle, plays and records."""
