"""Universal Robots over RTDE: motion through `ur-rtde`, samples by our own reader."""
