"""Deep Lagrangian networks with friction, in PyTorch; imported late, by whoever fits one."""
