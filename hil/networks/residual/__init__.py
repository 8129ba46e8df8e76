"""A small network for what a physical model leaves: causal, streamed, trained at the full rate."""
