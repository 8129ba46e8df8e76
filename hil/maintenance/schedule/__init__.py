"""When a robot is probed and identified again: due times, what was done at them, the loop."""
