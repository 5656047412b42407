"""Agents: one Double-DQN core, and each of the paper's agents as a short declaration on it."""
