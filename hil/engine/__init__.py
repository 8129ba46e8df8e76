"""The run state machine: the only thing that moves a robot."""
