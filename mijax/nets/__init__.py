"""Flax modules and nothing else: sequence memories, encoders, heads and the two-branch agent."""
