"""An arm behind a Beckhoff PLC, by ADS: the PLC owns the cycle, plays and records.

`robot` is what `hil` sees. It uploads motions and commands by a `controller`, and pulls what the
PLC has recorded by `reading`. Both use the PLC's `variables`, whose bytes come and go over `ads`.
"""
