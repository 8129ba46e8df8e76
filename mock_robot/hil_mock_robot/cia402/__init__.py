"""Six CiA 402 drives on a CAN bus, with the simulated arm between them."""
