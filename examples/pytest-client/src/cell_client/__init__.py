"""A small cell: a UR arm and one axis on a CiA 402 drive."""
