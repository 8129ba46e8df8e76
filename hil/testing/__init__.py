"""For people who test: mock robots for their tests, and the contract of a robot as checks."""
