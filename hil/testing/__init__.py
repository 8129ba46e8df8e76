"""For people who test drivers: the contract of a robot as checks."""
