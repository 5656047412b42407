"""mijax: memory-based agents under partial observability, trained with the simulator's state, in JAX."""

__version__ = "0.1.0"
