"""A mock robot, true to physics and to wire protocol."""
