"""Mock UR controller on loopback sockets: the client interfaces and a simulated arm."""
