"""Environments of one's own, from a few lines on."""
