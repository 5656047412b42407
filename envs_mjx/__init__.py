"""Partially observable environments as pure JAX functions: grid worlds and robot tasks."""
