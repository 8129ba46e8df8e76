"""Driver of an arm behind a Beckhoff PLC (ADS); the PLC executes and records the motions.

`robot` is the driver that `hil` opens. The driver uploads motions and sends commands with a
`controller`, and fetches the rows recorded by the PLC with `reading`. The modules `controller` and
`reading` access the PLC's `variables`, whose bytes are transferred by `ads`.
"""
