"""Mock of CiA 402 drives on a CAN bus, together with the simulated arm that they move."""
